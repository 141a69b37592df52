"""The JSON schema of case files, from which editors complete keys and show what they mean."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from livepde.cases.schema import CaseSpec

SCHEMA_FILE = "livepde.schema.json"  # beside a case that `livepde init` writes
DIALECT = "https://json-schema.org/draft/2020-12/schema"

BROKER = {
    "host": "Name of the broker's machine.",
    "port": "Port of the broker.",
    "client_id": "Name of this client at the broker; each run needs its own. "
    "Without it: livepde-CASE.",
    "username": "User name at the broker.",
    "password_env": "Environment variable that contains the password: LIVEPDE_..., or one that "
    "--allow-env allows.",
    "tls": "Whether the connection is encrypted.",
    "ca_file": "File of the certificates that are trusted; without it those of the system.",
    "session": "How long the broker keeps messages for a run that is stopped; a time.",
}
NODES = {
    "url": "Address of the server, opc.tcp://HOST:PORT.",
    "username": BROKER["username"].replace("broker", "server"),
    "password_env": BROKER["password_env"],
    "security": "Encryption: POLICY,MODE,CERTIFICATE,KEY[,CERTIFICATE OF THE SERVER], such as "
    "Basic256Sha256,SignAndEncrypt,cert.pem,key.pem.",
}
PRIOR = {
    "prior": "Best guess before seeing data, in the unit of the unknown, or with a unit.",
    "std": "Standard deviation of the prior, in the unit of the unknown, or with a unit.",
    "bounds": "[low, high]: estimates stay between these values, in the unit of the unknown.",
    "transform": '"log" keeps the unknown positive, "logit" strictly between its bounds.',
    "evolution": "How the unknown changes in time; without it, it is constant.",
    "within": "Largest distance of the latent value from its prior mean, in prior standard "
    "deviations.",
}
# Table, by the name of its class -> key -> meaning, with the unit of a number.
MEANINGS: Mapping[str, Mapping[str, str]] = {
    "CaseSpec": {
        "title": "Title of tables and figures.",
        "equation": 'Name of a ready-made equation ("livepde equations" lists them), or '
        '"file.py:function" (run it with --allow-code).',
        "initial": 'Initial state: "interpolate" (from the first sample), a number in the unit of '
        "the state, or a table with the key from.",
        "mesh": "Domain and elements.",
        "options": "Known numbers of the equation, each in its unit.",
        "boundary": "Boundary -> value of the state, or a table with a flux or an exchange; other "
        "boundaries are closed.",
        "sources": "Name -> source in a part of the domain.",
        "inputs": "Input of the equation that is constant -> its value, in its unit.",
        "data": "Where rows come from, and how their times are read.",
        "intake": "Rows of a live run that are late, repeated, malformed or too fast.",
        "unknowns": "Unknown of the equation -> its prior.",
        "channels": "Channel of the data -> its role, column and place.",
        "law": "Estimator; without it the sensitivity law with its defaults.",
        "steps": "Time steps between samples.",
        "output": "What a run stores and publishes.",
        "reference": "Unknown -> value that others found, in the unit of the unknown; source -> "
        "who found it.",
        "expect": 'Number of the run -> [low, high], "<= number" or ">= number".',
        "variants": "The case with other values; python -m benchmarks cases runs them.",
    },
    "MeshSpec": {
        "from": "Left end of an interval; a length.",
        "to": "Right end of an interval; a length.",
        "nodes": "Nodes of an interval, increasing; lengths.",
        "x": "[from, to] of a rectangle, or its nodes in x; lengths.",
        "y": "[from, to] of a rectangle, or its nodes in y; lengths.",
        "file": "Mesh file, in a format that meshio reads.",
        "unit": "Unit of length of the mesh file; without it that of the model.",
        "cells": "Number of elements; of a rectangle [in x, in y].",
        "spacing": '"uniform", or "geometric": elements that grow by a constant ratio.',
    },
    "MqttSpec": {
        **BROKER,
        "rows": "Topics whose messages are rows, as JSON objects.",
        "columns": "Topic -> column whose numbers its messages are.",
    },
    "PublishSpec": {
        **BROKER,
        "topic": "Topic to which estimates are published.",
        "discovery": "Whether Home Assistant finds the estimates by itself.",
    },
    "OpcuaSpec": {
        **NODES,
        "columns": "Node -> column whose numbers it has.",
        "interval": "Interval at which the server samples its nodes; a time.",
    },
    "NodesSpec": {
        **NODES,
        "columns": "Node -> what is written to it: NAME or NAME_std of an unknown, or verdict.",
    },
    "FileSpec": {
        "file": "CSV file, relative to the case.",
        "separator": "Separator of fields; without it that of [data].",
        "decimal": "Decimal mark; without it that of [data].",
        "encoding": "Encoding of the text; without it that of [data].",
        "skip": "Lines before the header; without it as in [data].",
        "time": "Column of times, or of days and times of day; without it that of [data].",
        "time_unit": "Unit of times that are numbers; without it that of [data].",
        "time_format": "Format of dates; without it that of [data].",
    },
    "DataSpec": {
        "file": "CSV, .jsonl or .parquet file, relative to the case; may contain ${LIVEPDE_DATA}. "
        "Several CSV files are joined by time.",
        "follow": "Whether the file grows, so that more is waited for at its end.",
        "mqtt": "Message broker instead of a file.",
        "opcua": "OPC UA server instead of a file.",
        "separator": "Separator of the fields of a CSV file.",
        "decimal": "Decimal mark of numbers in a CSV file.",
        "encoding": "Encoding of a CSV file, such as cp1252.",
        "reader": '"file.py:function" instead of a file (run it with --allow-code).',
        "options": "Arguments of the reader.",
        "skip": "Lines before the header of a CSV file.",
        "time": "Column of times: dates or numbers; or the columns of days and of times of day.",
        "time_unit": "Unit of times that are numbers; without it that of the model.",
        "time_format": "Format of dates that are not in ISO format, such as %d.%m.%Y %H:%M.",
        "zone": "Time zone of dates that name none, such as Europe/Berlin.",
        "start": "First time that is used: a date, or a time in the unit of the model.",
        "stop": "Last time that is used: a date, or a time in the unit of the model.",
        "assimilate_from": "Samples before this date or time drive inputs and are not assimilated.",
        "every": "Number of rows of which one is kept.",
        "missing": "Numbers that mean a missing value, such as -9999.",
    },
    "IntakeSpec": {
        "wait": "How much later than newer ones a row may come; a time.",
        "tolerance": "Rows whose times differ by at most this form one sample; a time.",
        "leap": "A row further ahead than this has to be confirmed by others; a time. Without "
        "it: 30 days.",
        "repeated": "Which of two values for one moment is used.",
        "shift": "Correction of the clock of the source, added to all times; a time.",
        "overflow": "Samples that come faster than steps wait, are merged, or are dropped.",
        "queue": "Number of samples that may wait.",
        "silence": "A source is silent after this time without a row; without it after ten usual "
        "intervals, twice its longest silence so far, and 60 s.",
    },
    "EvolutionSpec": {
        "kind": "Kind of the evolution.",
        "rate": "Of a random walk: standard deviation after one unit of time, growing as sqrt(t).",
        "time": "Of mean reversion: time within which the unknown returns to its prior.",
        "period": "Of a periodic unknown: its period; a time.",
        "harmonics": "Number of harmonics of a periodic unknown.",
    },
    "RegionSpec": {
        **PRIOR,
        "over": "[from, to], a box [x0, x1, y0, y1] (lengths), or a subdomain of the mesh.",
    },
    "UnknownSpec": {
        **PRIOR,
        "unit": "Unit of numbers without one; without it that of the equation.",
        "regions": "Name -> region with its own number.",
        "field": "Whether the unknown is a function of x.",
        "length": "Correlation length of a field; a length.",
    },
    "CorrelatedSpec": {
        "time": "Time within which the error fades.",
        "std": "Standard deviation of the error, in the unit of the channel.",
    },
    "ChannelSpec": {
        "role": "sensor: assimilated. validation: predicted only. ignored: shown "
        "only. boundary: value of the state there. input: read by the equation. position: of a "
        "sensor that moves.",
        "column": "Column of the data; {} is replaced by the numbers of a family of sensors.",
        "columns": "Columns that are averaged.",
        "at": "Position, a length or one for each coordinate; or the name of a boundary.",
        "at_std": "Standard deviation of the position; a length.",
        "over": "Mean over [from, to], a box (lengths), or a named boundary or subdomain.",
        "along": "Mean along the line [start, end]; lengths.",
        "follows": "Channel of role position, or one for each coordinate, of a sensor that moves.",
        "each": "[from, to, count]: a family of point sensors; lengths.",
        "positions": "CSV file of name, x (and y, z): a point sensor for each row.",
        "quantity": 'Measured quantity of the equation, or "flux" with at.',
        "of": "Component of the state that is measured.",
        "component": "Component of a vector that is measured, from 0.",
        "noise": "Standard deviation of a reading, in the unit of the channel.",
        "noise_column": "Column with the standard deviation of each reading.",
        "unit": "Unit of the column; without it that of the model.",
        "factor": "Number by which the values are multiplied, before the unit is converted.",
        "late": "How much later than its values the times of the channel are.",
        "offset": "Standard deviation of an unknown offset, in the unit of the channel.",
        "gain": "Standard deviation of an unknown factor about 1.",
        "correlated": "An error of the sensor that fades.",
        "wait": "How long a sample waits for this channel; a time. Without it as in [intake].",
        "repeated": "Which of two values for one moment is used; without it as in [intake].",
        "valid": "[low, high]: a value outside is not used; in the unit of the channel.",
        "missing": "Treatment of gaps; without it interpolate for inputs, hold for others.",
        "spikes": "Whether spikes of an input are rejected; without it they are.",
        "between": "Input between two readings: line, hold (until the next reading) or next (mean "
        "since the last reading).",
    },
    "SensitivitySpec": {
        "kind": "Reduced-rank Kalman filter, for few, noisy sensors.",
        "noise": "Standard deviation of all sensors that state none, in the unit of the state.",
        "modes": "Number of modes of each unknown field.",
        "rank": "Columns of the covariance factor while unknowns move.",
        "gate": "Innovations of more than so many expected standard deviations are not used.",
        "gate_patience": "After so many refusals in a row a sensor is examined.",
        "shadows": "Whether discretisation errors widen the intervals; or a table of options.",
        "drift": "Variance gained per time by every unknown, relative to its prior; 1/time.",
        "memory": "Time with which the cross-covariance of state and unknowns decays; without it "
        "never.",
        "refit": "Whether all stored samples are fitted again; or a table of options.",
        "jumps": "Whether sudden changes are looked for, or of which unknowns; or a table of "
        "options.",
        "guards": "Whether safeguards are used; or a table of options.",
        "verdict": 'Whether the run is assessed; "cheap" leaves out tests that require solves.',
    },
    "TikhonovSpec": {
        "norm": "Norm of the penalty.",
        "alpha": "Weight of the penalty, or its choice by the discrepancy principle.",
        "tau": "Factor on the noise in the discrepancy principle.",
    },
    "GradientSpec": {
        "kind": "Adaptive observer of the paper, for observed subdomains and averages.",
        "gain": "Gain of the parameter, or its choice by the law.",
        "c1": "Constant of the damping by the residual.",
        "mu": "Constant damping.",
        "nu": "Weight of the unobserved part.",
        "sigma": "Leakage of the parameter, 1/time.",
        "tikhonov": "Whether the observed part is regularised; or a table of options.",
    },
    "StepsSpec": {
        "dt_max": "Longest time step; a time. Without it the intervals of the samples.",
        "scheme": "Time scheme; without it that of the law.",
    },
    "OutputSpec": {
        "fields_every": "Number of samples of which one is stored with its fields.",
        "retain": "How long a live run keeps everything; a time. Without it forever.",
        "thin": "Number of older estimates of which one is kept.",
        "smoothed": "Whether a finished run ends with estimates given all samples.",
        "surface_resistances": "[inside, outside] of a wall, for its U-value; m^2 K/W.",
        "mqtt": "Broker to which a live run publishes its estimates.",
        "opcua": "OPC UA server to which a live run writes its estimates.",
    },
    "VariantSpec": {
        "name": "Name of the variant.",
        "set": "Key -> value that the variant has instead.",
        "seeds": "Number of runs, with data.options.seed = 0, 1, ...",
        "reference": "As [reference], for this variant.",
        "expect": "As [expect], for this variant.",
    },
    "BoundarySpec": {
        "value": "Value of the state: a number in its unit, a channel or an unknown.",
        "flux": "Flux into the domain: a number in its unit, a channel or an unknown.",
        "transfer": "Coefficient h of an exchange h (ambient - u): a number or an unknown.",
        "ambient": "Ambient value of an exchange: a number, a channel or an unknown.",
    },
    "SourceSpec": {
        "value": "Source per volume and time: a number in its unit, a channel or an unknown.",
        "over": "[from, to], a box (lengths), or a subdomain; without it everywhere.",
    },
    "InitialSpec": {
        "from": 'Initial state: "interpolate", a number in the unit of the state, or text.',
        "std": "Standard deviation of the initial state, in its unit.",
        "length": "Correlation length of the error of the initial state; a length.",
    },
}


def case_schema() -> dict[str, Any]:
    """Return the JSON schema of a case file, with the meaning and the default of each key."""
    schema = CaseSpec.model_json_schema(by_alias=True)
    for name, table in [("CaseSpec", schema), *schema["$defs"].items()]:
        summary, options = documented(table.get("description", ""))
        table["description"] = summary
        meanings = {**options, **MEANINGS.get(name, {})}
        for key, value in table["properties"].items():
            if key in meanings:
                value["description"] = meanings[key]
    return {"$schema": DIALECT, **schema, "title": "A case of livepde"}


def documented(text: str) -> tuple[str, dict[str, str]]:
    """Return the summary of a docstring, and parameter -> its meaning.

    Options of a law are documented where they are declared, and only there.
    """
    summary = text.partition("\n\n")[0].replace("\n", " ")
    listed = re.search(r"^Parameters\n-+\n(.*?)(?:\n\n|\Z)", text, flags=re.DOTALL | re.MULTILINE)
    items = re.findall(r"^(\w+)\n((?: +.*\n?)+)", listed[1] if listed else "", flags=re.MULTILINE)
    return summary, {name: " ".join(meaning.split()) for name, meaning in items}
