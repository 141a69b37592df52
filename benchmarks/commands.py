"""Command-line programs for measurements: each command is a function that returns an outcome."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, TypeAlias, get_args

import typer

from livepde.cli.experiments import run_experiment
from livepde.cli.options import JsonOption
from livepde.cli.printing import named
from livepde.runs import Outcome

Measurement: TypeAlias = Callable[..., Outcome]

Out = Annotated[
    Path | None,
    typer.Option(help="Write dataset and figures to a new run directory.", show_default=False),
]
Workers = Annotated[
    int | None, typer.Option(min=1, help="Processes, default one for each processor.")
]


@dataclass(frozen=True)
class Count:
    """Option with a whole number, declared as `Annotated[int, Count(...)]`.

    Attributes
    ----------
    usual, quick
        Default values without and with --quick.
    help
        Meaning of the number.
    least
        Smallest value.
    """

    usual: int
    quick: int
    help: str
    least: int = 1

    @property
    def option(self) -> Any:
        """Typer option with this help and bound."""
        return typer.Option(min=self.least, help=f"{self.help} With --quick {self.quick}.")


def several(what: str, *flags: str, **bounds: Any) -> Any:
    """Return a repeatable option, for `Annotated[list[T] | None, ...]`."""
    return typer.Option(*flags, help=f"{what} Repeat for more.", **bounds)


def chosen(
    names: Sequence[str] | None, known: Collection[str], what: str, default: Collection[str] = ()
) -> list[str]:
    """Return the given names, or the default if there are none.

    Raises
    ------
    ConfigurationError
        A name is unknown.
    """
    for name in names or ():
        named(name, dict.fromkeys(known), what)
    return list(names or default)


class Program:
    """Command-line program with one command for each measurement.

    Parameters
    ----------
    words
        Command that starts the program, such as "python -m benchmarks".
    help
        Description, with an example in its last line.
    keeps
        True: every command has an option --out for a run directory.
    """

    def __init__(self, words: str, help: str, *, keeps: bool = False) -> None:
        self.words = words
        self.keeps = keeps
        self.app = typer.Typer(
            name=words.split()[-1],
            help=help,
            no_args_is_help=True,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode="rich",
            context_settings={"help_option_names": ["-h", "--help"]},
        )
        self.app.callback()(lambda: None)  # a program with one command requires its name, too

    def command(self, quick: str, name: str | None = None) -> Callable[[Measurement], Measurement]:
        """Return a decorator that adds a function as a command with --quick and --json.

        Each parameter of the function becomes an option. Parameters named `quick` and `as_json`
        receive the values of these options. The docstring is the help.

        Parameters
        ----------
        quick
            Help of --quick: what it leaves out.
        name
            Name of the command; default the name of the function.
        """

        def add(function: Measurement) -> Measurement:
            parameters = inspect.signature(function, eval_str=True).parameters
            counts = {key: count for key, item in parameters.items() if (count := _count(item))}

            def run(context: typer.Context, **given: Any) -> None:
                shared = {key: given.pop(key, None) for key in ("quick", "as_json", "out")}
                for key, count in counts.items():
                    if shared["quick"] and not _is_given(context, key):
                        given[key] = count.quick
                given |= {key: shared[key] for key in shared if key in parameters}
                words = self._words(context, hidden)
                title = (inspect.getdoc(function) or "").split("\n")[0].rstrip(".")
                measured = partial(function, **given)
                run_experiment(measured, shared["out"], words, title, shared["as_json"])

            shared = {
                "quick": (Annotated[bool, typer.Option("--quick", help=quick)], False),
                "as_json": (JsonOption, False),
                **({"out": (Out, None)} if self.keeps else {}),
            }
            _declare(run, parameters, shared, counts)
            options = inspect.signature(run).parameters.items()
            hidden = {"as_json", *(key for key, item in options if _takes_path(item))}
            run.__doc__ = function.__doc__
            self.app.command(name or function.__name__)(run)
            return function

        return add

    def _words(self, context: typer.Context, hidden: Collection[str]) -> list[str]:
        """Return the words of the command, with all option values except those set by --quick."""
        words = [*self.words.split(), context.command.name or ""]
        for option in context.command.params:
            name, flag = option.name or "", max(option.opts, key=len)
            value = context.params.get(name)
            shown = _is_given(context, name) or not context.params["quick"]
            if name in hidden or value is None or not shown:
                continue
            if isinstance(value, bool):
                words += [flag] if value else []
                continue
            for item in value if isinstance(value, list | tuple) else [value]:
                words += [flag, f"{item:g}" if isinstance(item, float) else str(item)]
        return words


def _count(parameter: inspect.Parameter) -> Count | None:
    """Return the `Count` in the annotation of a parameter, or None."""
    metadata = getattr(parameter.annotation, "__metadata__", ())
    return next((item for item in metadata if isinstance(item, Count)), None)


def _takes_path(parameter: inspect.Parameter) -> bool:
    """Return whether a parameter is `Annotated[Path, ...]` or `Annotated[Path | None, ...]`."""
    kind, *_ = get_args(parameter.annotation) or (parameter.annotation,)
    return Path in (kind, *get_args(kind))


def _declare(
    run: Callable[..., None],
    parameters: Mapping[str, inspect.Parameter],
    shared: Mapping[str, tuple[Any, Any]],
    counts: Mapping[str, Count],
) -> None:
    """Set the signature of a command, from which Typer reads its options."""
    keyword = inspect.Parameter.KEYWORD_ONLY
    declared = [inspect.Parameter("context", keyword, annotation=typer.Context)]
    for name, item in parameters.items():
        if name in shared:
            continue
        if (count := counts.get(name)) is not None:
            option = Annotated[int, count.option]
            item = item.replace(annotation=option, default=count.usual)
        declared.append(item.replace(kind=keyword))
    declared += [
        inspect.Parameter(name, keyword, annotation=option, default=default)
        for name, (option, default) in shared.items()
    ]
    run.__signature__ = inspect.Signature(declared)  # type: ignore[attr-defined]
    run.__annotations__ = {}


def _is_given(context: typer.Context, name: str) -> bool:
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"
