"""The commands put together, and how each of them ends."""

from __future__ import annotations

import os
import warnings
from typing import TYPE_CHECKING, Annotated

import typer

from nodegraph import __version__
from nodegraph.cli import CANCELLED, cachecommands, catalogue, documents, planning, running
from nodegraph.cli.console import Console
from nodegraph.cli.session import Session
from nodegraph.errors import NodegraphError

if TYPE_CHECKING:
    from nodegraph.cli.direct import Call

_PROGRAM = "nodegraph"
# typer brings click with it or inside it, as of its version; the exceptions are the same classes either way.
_UsageError: type[Exception] = next(cls for cls in typer.BadParameter.__mro__ if cls.__name__ == "ClickException")


def _version(wanted: bool) -> None:
    if wanted:
        print(f"{_PROGRAM} {__version__}")
        raise typer.Exit


app = typer.Typer(
    name=_PROGRAM,
    help="Run, inspect and share dataflow graphs.",
    context_settings={"help_option_names": ["-h", "--help"]},
    rich_markup_mode=None,
)


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Run, inspect and share dataflow graphs."""


for commands in (running, planning, documents, catalogue):
    commands.add_to(app)
app.add_typer(cachecommands.app, name="cache")


def invoke(arguments: list[str], call: Call | None = None) -> int:
    """Run the command that `arguments` name, print what goes wrong, and return the exit status."""
    command = typer.main.get_command(app)
    if f"_{_PROGRAM.upper()}_COMPLETE" in os.environ:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return command.main(arguments, prog_name=_PROGRAM, standalone_mode=False) or 0
    console = Console()
    try:
        with (
            console.listening(),
            command.make_context(_PROGRAM, list(arguments) or ["--help"], obj=Session(console, call)) as context,
        ):
            return command.invoke(context) or 0
    except typer.Exit as done:
        return done.exit_code
    except (KeyboardInterrupt, typer.Abort):
        console.error("cancelled")
        return CANCELLED
    except _UsageError as error:
        console.error(_usage(error))
        return 2
    except NodegraphError as error:
        console.report(error)
        return error.exit_status
    except BrokenPipeError:
        raise
    except OSError as error:
        console.report(error)
        return 2
    except Exception as error:  # a mistake in the program: whoever reports it needs to see where
        console.trace(error)
        console.error("this is a mistake in nodegraph; please report it with the lines above")
        return 1


def _usage(error: Exception) -> str:
    message = getattr(error, "format_message", lambda: str(error))()
    context = getattr(error, "ctx", None)
    path = context.command_path if context is not None else _PROGRAM
    first = " ".join(str(message).split()).rstrip(".")
    return f"{first[:1].lower()}{first[1:]}; '{path} --help' says more"
