"""The command line: the app of all commands, and the handling of their errors.

An error that the user can mend ends as one sentence on stderr with exit code 1 (2 for a wrong call). Any other
exception is a bug and shows its traceback.
"""

from __future__ import annotations

import os
import sys
import warnings
from typing import Annotated

import typer

from . import __version__
from .commands.bench import bench
from .commands.chart import chart
from .commands.decode import decode
from .commands.edit import edit
from .commands.encode import encode
from .commands.eval import evaluate
from .commands.info import info
from .commands.masks import masks
from .commands.mux import mux
from .commands.play import play
from .commands.render import render
from .commands.train import train
from .errors import GscodecError

app = typer.Typer(
    help="Streaming volumetric video: captures and Gaussian sequences to one small playable file.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
for command in (encode, train, decode, render, play, info, masks, mux, edit):
    app.command()(command)
app.command(name="eval")(evaluate)
app.add_typer(bench, name="bench")
app.command()(chart)


def _show_version(value: bool) -> None:
    if value:
        print(__version__)
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _show_warning(message, category, filename, lineno, file=None, line=None) -> None:
    print(f"warning: {message}", file=sys.stderr)


def main() -> None:
    """Entry point of the `gscodec` command."""
    warnings.showwarning = _show_warning
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for scipy, imported later; the encoder has threads
    try:
        sys.exit(app(standalone_mode=False))  # None from a command, or the code of a typer.Exit
    except (typer.Abort, KeyboardInterrupt):
        print("stopped", file=sys.stderr)
        sys.exit(130)
    except GscodecError as e:
        print(f"error: {e}", file=sys.stderr)
        sys.exit(1)
    except OSError as e:
        where = f"{e.filename}: " if e.filename else ""
        print(f"error: {where}{e.strerror or e}", file=sys.stderr)
        sys.exit(1)
    except Exception as e:
        if type(e).__module__.startswith(("click", "typer")):  # a wrong call
            show = getattr(e, "show", None)
            show() if show else print(f"error: {e}", file=sys.stderr)
            sys.exit(getattr(e, "exit_code", 2))
        raise
