"""Generates the reference of the command line from the commands: `make docs` writes docs/reference.md.

.venv/bin/python -m brewster.cli.reference > docs/reference.md"""

import inspect
from collections.abc import Iterator

import click

from brewster.cli import cli

_BEGINNING = """# The command line

`make docs` generates this page from the commands; a test checks that it is up to date.

Exit codes: 0 success, 1 error (each error is one line `error: ...` on standard error), 2 invalid arguments, 130 interrupted
by Ctrl-C."""


def reference() -> str:
    """Returns the page in Markdown, with a section for each command and its options."""
    context = click.Context(cli, info_name="brewster", show_default=True)
    return "\n\n".join([_BEGINNING, *_sections(cli, context)]) + "\n"


def _sections(command: click.Command, context: click.Context) -> Iterator[str]:
    yield f"## {context.command_path}"
    yield f"    {context.command_path} {' '.join(command.collect_usage_pieces(context))}"
    yield inspect.cleandoc(command.help or "")
    rows = [_row(param, context) for param in command.params if isinstance(param, click.Option)]
    if rows:
        yield "\n".join(["| option | meaning |", "|---|---|", *rows])
    if isinstance(command, click.Group):
        for name, child in sorted(command.commands.items()):
            yield from _sections(child, click.Context(child, info_name=name, parent=context))


def _row(option: click.Option, context: click.Context) -> str:
    value = "" if option.is_flag else f" {option.make_metavar(context)}"
    default = option.get_help_extra(context).get("default")
    usage = f"{', '.join(option.opts)}{value}".replace("|", "\\|")
    return f"| `{usage}` | {option.help}{f' Default: `{default}`.' if default else ''} |"


if __name__ == "__main__":
    click.echo(reference(), nl=False)
