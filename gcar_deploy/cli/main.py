"""gcar: the command group; verbs are imported when they are called, errors become one line."""

from __future__ import annotations

import atexit
import gc
import importlib
import logging
import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn

import click

from gcar_deploy.cli.common import ToldError, say, say_failure, silence

#: verb -> (module, what ``gcar --help`` says of it); kept here so that help imports nothing.
VERBS = {
    "run": ("gcar_deploy.cli.run", "Reconstruct a coronary tree from two or more pictures."),
    "open": ("gcar_deploy.cli.open", "See, correct and run a case in the browser."),
    "validate": ("gcar_deploy.cli.validate", "Check pictures and geometry; reconstruct nothing."),
    "frames": ("gcar_deploy.cli.frames", "Find the frames of two runs that go together."),
    "geometry": ("gcar_deploy.cli.geometry", "Read or show where the views were taken from."),
    "enhance": ("gcar_deploy.cli.enhance", "Show the steps of finding vessels in one picture."),
    "flow": (
        "gcar_deploy.cli.flow",
        "Tell the pressure drop at an assumed flow; files for solvers.",
    ),
    "dicom": ("gcar_deploy.cli.dicom", "Write a result as DICOM: report, captures, surface."),
    "slicer": ("gcar_deploy.cli.slicer", "Write a scene of a result for 3D Slicer."),
    "demo": ("gcar_deploy.cli.demo", "Reconstruct the case that comes along."),
    "batch": ("gcar_deploy.cli.batch", "Reconstruct every case of a table."),
    "serve": ("gcar_deploy.cli.serve", "Keep a warm engine for host programs."),
    "bench": ("gcar_deploy.cli.bench", "Measure speed against error."),
    "listen": ("gcar_deploy.cli.listen", "Reconstruct what arrives by DICOM C-STORE."),
    "doctor": ("gcar_deploy.cli.doctor", "Check this installation."),
    "info": ("gcar_deploy.cli.info", "Print what a result folder or a model is."),
}
#: verbs whose function has another name: a builtin's is not taken
_FUNCTIONS = {"open": "open_"}
INTERRUPTED, TERMINATED, INTERNAL = 130, 143, 1


class Terminated(BaseException):
    """SIGTERM or SIGHUP arrived; raised so that unfinished folders are taken away."""


class LazyGroup(click.Group):
    """Group whose verbs live in modules of their own."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the verbs in the order of a session."""
        return list(VERBS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import the verb."""
        if cmd_name not in VERBS:
            return None
        module, _ = VERBS[cmd_name]
        command: click.Command = getattr(
            importlib.import_module(module), _FUNCTIONS.get(cmd_name, cmd_name)
        )
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Find the verb; a misspelt one is told which it may have been."""
        name = args[0] if args else ""
        known = name in VERBS or name.startswith("-") or ctx.resilient_parsing
        if name and not known:
            import difflib

            close = difflib.get_close_matches(name[:80], VERBS, n=1, cutoff=0.5)
            hint = f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(VERBS)}"
            ctx.fail(f"no verb {name[:80]!r}{hint}")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the verbs without importing them."""
        with formatter.section("Verbs"):
            formatter.write_dl([(name, help_line) for name, (_, help_line) in VERBS.items()])


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="gcar", prog_name="gcar")
def gcar() -> None:
    """Coronary arteries in 3D from two X-ray angiograms. Research use only.

    \b
    Example:
      gcar run view1.png view2.png --geom geom.json --out result
    """  # noqa: D301 - click wants a real backspace


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise Terminated


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run the command and leave with the exit code of the contract."""
    arguments = sys.argv[1:] if arguments is None else arguments
    verbose = "-v" in arguments or "--verbose" in arguments
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            # Closed by whoever called: nobody has to ask, and no file opened later gets its number.
            stream = open(os.devnull, "w")  # noqa: SIM115 - open until the end
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)
    # All memory goes with the process: looking for cycles in it first takes 0.1 s.
    atexit.register(gc.freeze)
    # Many small products: shared out, they wait for each other where another program has a core,
    # and last digits depend on the cores. Heeded only before numpy is imported.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # A terminal that goes away (SIGHUP, where there is such a signal) must leave nothing either;
    # nohup has it ignored.
    kinds = [getattr(signal, name, None) for name in ("SIGTERM", "SIGHUP")]
    previous = {
        kind: signal.signal(kind, _terminate)
        for kind in kinds
        if kind is not None and signal.getsignal(kind) != signal.SIG_IGN
    }
    try:
        code = _run(arguments, verbose)
        # What could not be written there would be tried once more at exit, which ends with 120.
        say("", nl=False)
        try:
            sys.stdout.flush()
        except OSError:
            silence(sys.stdout)
            code = code or INTERNAL
    finally:
        for kind, own in previous.items():
            signal.signal(kind, own)
    sys.exit(code)


def _run(arguments: list[str], verbose: bool) -> int:
    from gcar_deploy.errors import GcarError, out_of_memory

    try:
        out: Any = gcar.main(arguments, prog_name="gcar", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        say(error.format_message())
        return error.exit_code
    except ToldError as told:
        return _fail(str(told.error), told.error.exit_code)
    except (click.ClickException, GcarError) as error:
        sentence = error.format_message() if isinstance(error, click.ClickException) else str(error)
        if "--json" in arguments and _has_option(arguments, "--json"):
            say_failure(sentence, error.exit_code)
        return _fail(sentence, error.exit_code)
    except (KeyboardInterrupt, click.Abort):
        return _fail("interrupted", INTERRUPTED)
    except Terminated:
        return _fail("terminated", TERMINATED)
    except BrokenPipeError:
        # Of stderr, ``say`` swallows it: the reader of stdout went away.
        silence(sys.stdout)
        return INTERNAL
    except Exception as error:
        if (stopped := _stopped(error)) is not None:
            return _fail(*stopped)
        if out_of_memory(error):
            return _fail("out of memory; use a smaller volume or smaller pictures", INTERNAL)
        if isinstance(error, OSError):
            return _fail(f"{error.filename or 'cannot write'}: {error.strerror or error}", INTERNAL)
        # The last line of defence: never a traceback.
        if verbose:
            logging.getLogger("gcar_deploy").exception("internal error")
        detail = str(error).splitlines()[0] if str(error) else ""
        hint = "; see -v" if _has_option(arguments, "-v") else ""
        return _fail(f"internal error: {type(error).__name__} {detail}".strip() + hint, INTERNAL)
    return out if isinstance(out, int) else 0


def _has_option(arguments: list[str], name: str) -> bool:
    """Whether the verb has an option: ``-v`` to say more, ``--json`` for one object."""
    verb: click.Command | None = gcar
    for word in arguments:
        if not isinstance(verb, click.Group):
            break
        verb = verb.get_command(click.Context(verb), word)
    return verb is not None and any(name in option.opts for option in verb.params)


def _stopped(error: BaseException | None) -> tuple[str, int] | None:
    """Tell whether a signal is behind an error: a library being loaded makes it its own."""
    while error is not None:
        if isinstance(error, Terminated):
            return "terminated", TERMINATED
        if isinstance(error, KeyboardInterrupt):
            return "interrupted", INTERRUPTED
        error = error.__cause__ or error.__context__
    return None


def _fail(message: str, code: int) -> int:
    line = " ".join(message.split())
    say(f"gcar: error: {line}")
    return code


if __name__ == "__main__":
    main()
