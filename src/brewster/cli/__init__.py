"""The command `brewster`. No other package uses click or rich.

Commands import slow modules when they run, so that `brewster --help` starts fast."""

import difflib
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import click
from click.shell_completion import CompletionItem, get_completion_class

import brewster
from brewster.cli import (
    assets,
    burst,
    doctor,
    evaluate,
    info,
    models,
    render,
    separate,
    serve,
    study,
    train,
)
from brewster.cli.terminal import interrupts, print_error, print_out, print_status, standard_output
from brewster.errors import BrewsterError

_EXIT_INTERRUPTED = 130  # what a shell expects after Ctrl-C: 128 + SIGINT
_HELP_OPTIONS = ["-h", "--help"]
_VERSION_OPTIONS = ["-v", "-V", "--version"]
_GROUP_OPTIONS = {*_HELP_OPTIONS, *_VERSION_OPTIONS}
_RESUMED = ("models", "train", "assets", "render", "evaluate")
"""The commands that keep what they have finished or downloaded."""


class _DefaultCommandGroup(click.Group):
    """A click group that treats an unknown command as a photo."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        if args[:1] == ["help"] and not Path("help").exists():
            args = [*args[1:], "--help"]
        if args and args[0] not in self.commands and args[0] not in _GROUP_OPTIONS:
            close = difflib.get_close_matches(args[0], self.commands, n=1, cutoff=0.7)
            is_misspelled = close and args[0].isalpha() and not Path(args[0]).exists()
            if is_misspelled and not ctx.resilient_parsing:  # shell completion
                ctx.fail(f"{args[0]!r} is neither a photo nor a command. Did you mean {close[0]}?")
            args = ["separate", *args]
        return super().parse_args(ctx, args)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Completes commands, and also the photos and options of `separate`, because its name can
        be left out.
        """
        separate_items = self.commands["separate"].shell_complete(ctx, incomplete)
        items = [*super().shell_complete(ctx, incomplete), *separate_items]
        files = [] if incomplete.startswith("-") else [CompletionItem(incomplete, type="file")]
        return [*{item.value: item for item in items}.values(), *files]


@click.group(
    cls=_DefaultCommandGroup,
    subcommand_metavar="PHOTO... | COMMAND [ARGS]...",
    context_settings={"help_option_names": _HELP_OPTIONS, "show_default": True},
)
@click.version_option(
    brewster.__version__,
    *_VERSION_OPTIONS,
    message="brewster %(version)s",
    help="Print the version.",
)
def cli() -> None:
    """Separate photos taken through glass into transmission and reflection.

    The transmission is the scene behind the glass. The reflection is the scene that the glass
    mirrors. `brewster PHOTO...` is short for `brewster separate PHOTO...`; `brewster separate
    --help` shows its options.
    """


@cli.command
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the script that completes commands, options, models and file names in a shell.

    For bash, put this line into ~/.bashrc: eval "$(brewster completion bash)". For zsh, put the
    same line with zsh into ~/.zshrc. For fish: brewster completion fish | source
    """
    kind = get_completion_class(shell)
    assert kind
    print_out(kind(cli, {}, "brewster", "_BREWSTER_COMPLETE").source())


for _module in (
    separate,
    burst,
    info,
    models,
    doctor,
    train,
    assets,
    render,
    evaluate,
    serve,
    study,
):
    cli.add_command(getattr(_module, _module.__name__.rpartition(".")[2]))


def _leaf_commands(group: click.Group) -> Iterator[click.Command]:
    for command in group.commands.values():
        yield from _leaf_commands(command) if isinstance(command, click.Group) else [command]


for _command in _leaf_commands(cli):
    assert _command.callback
    _command.callback = standard_output.reserved()(_command.callback)


def main(args: Sequence[str] | None = None) -> int:
    """Runs the command line, and returns the exit code: 0 success, 1 error, 2 invalid arguments,
    130 Ctrl-C.
    """
    standard_output.redirect_descriptor()
    try:
        with interrupts.captured():
            return int(cli.main(args, prog_name="brewster", standalone_mode=False) or 0)
    except click.ClickException as error:
        error.show()
        return error.exit_code
    except click.Abort:
        is_resumed = interrupts.has_finished_work or {*_RESUMED} & {*(args or sys.argv[1:])[:1]}
        kept = ": finished work is kept; run the same command again to resume"
        print_status(f"stopped{kept if is_resumed else ''}")
        return _EXIT_INTERRUPTED
    except BrewsterError as error:
        for message in error.messages():
            print_error(message)
        return 1
