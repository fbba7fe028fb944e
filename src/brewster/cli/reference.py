"""The reference of the command line, made from the commands themselves: `make docs` writes docs/reference.md.

.venv/bin/python -m brewster.cli.reference > docs/reference.md
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator

import click

from brewster.cli import cli

_BEGINNING = """# The command line

Made from the commands by `make docs`; a test keeps it true.

Exit codes: 0 all went well, 1 an error (one line `error: ...` for each on standard error), 2 a wrong usage,
130 stopped by Ctrl-C."""


def reference() -> str:
    """Every command with its options, Markdown."""
    return "\n\n".join([_BEGINNING, *_chapters(cli, click.Context(cli, info_name="brewster"))]) + "\n"


def _chapters(command: click.Command, context: click.Context) -> Iterator[str]:
    yield f"## {context.command_path}"
    yield f"    {context.command_path} {' '.join(command.collect_usage_pieces(context))}"
    yield inspect.cleandoc(command.help or "")
    rows = [_row(param) for param in command.params if isinstance(param, click.Option)]
    if rows:
        yield "\n".join(["| option | meaning |", "|---|---|", *rows])
    if isinstance(command, click.Group):
        for name, child in sorted(command.commands.items()):
            yield from _chapters(child, click.Context(child, info_name=name, parent=context))


def _row(option: click.Option) -> str:
    context = click.Context(cli)
    value = "" if option.is_flag else f" {option.make_metavar(context)}"
    default = f" Default: `{option.default}`." if option.show_default else ""
    words = f"{', '.join(option.opts)}{value}".replace("|", "\\|")
    return f"| `{words}` | {option.help}{default} |"


if __name__ == "__main__":
    click.echo(reference(), nl=False)
