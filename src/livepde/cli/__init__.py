"""The command line. Exit codes: 0 success, 1 a check failed, 2 bad input, 130 interrupted."""

import sys
from typing import Annotated

import typer
from rich.markup import escape
from threadpoolctl import threadpool_limits

from livepde import __version__
from livepde.cli.cases import equations, init, schema
from livepde.cli.check import check
from livepde.cli.compare import compare
from livepde.cli.experiments import citation, demo, reproduce
from livepde.cli.finished import export, fmu, report, watch
from livepde.cli.fleet_command import fleet
from livepde.cli.printing import BAD_INPUT, terminal
from livepde.cli.run import run
from livepde.errors import LivepdeError
from livepde.library_messages import tame_libraries

__all__ = ["app", "main"]

app = typer.Typer(
    name="livepde",
    help="""Estimate unknown parameters of partial differential equations from live data.

    Start with:  livepde demo,  then  livepde init mycase,  livepde run mycase/case.toml""",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    context_settings={"help_option_names": ["-h", "--help"]},
)
COMMANDS = (
    demo,
    init,
    check,
    run,
    fleet,
    watch,
    report,
    compare,
    export,
    fmu,
    equations,
    schema,
    reproduce,
    citation,
)
for command in COMMANDS:
    app.command()(command)


def main(program: typer.Typer | None = None) -> int:
    """Run a command line, by default `livepde`, and return its exit code."""
    tame_libraries()
    try:
        # The dense matrices of a step are small: several threads would be slower than one.
        with threadpool_limits(1):
            (program or app)(standalone_mode=True)
    except LivepdeError as error:
        terminal(err=True).print(f"[bold red]Error:[/] {escape(str(error))}")
        return BAD_INPUT
    except BrokenPipeError:  # the reader of a pipe has closed it
        sys.stderr.close()
    return 0


def _version(asked: bool) -> None:
    if asked:
        terminal().print(f"livepde {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass
