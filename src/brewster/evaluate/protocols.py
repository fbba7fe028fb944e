"""Protocols by name: the choices of papers and contests that change the scores, each with its source.

A published score can be compared with a measured score only if both use the same protocol. Reports list the choices."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final, final

from brewster.errors import BrewsterError
from brewster.evaluate.config import DEFAULT_METRICS, EvaluationConfig


@final
@dataclass(frozen=True)
class ProtocolPreset:
    """A row of PROTOCOLS: the choices of a protocol, as (choice, source), and its settings."""

    title: str
    choices: tuple[tuple[str, str], ...]
    config: EvaluationConfig


def protocol_config(name: str, **changes: Any) -> EvaluationConfig:  # noqa: ANN401  (the fields of EvaluationConfig)
    """Returns the settings of a protocol. `changes` are fields of `EvaluationConfig` that replace or complete them.
    Raises BrewsterError if there is no protocol of this name, or a value is invalid."""
    if name not in PROTOCOLS:
        raise BrewsterError(
            f"there is no protocol {name!r}", f"expected one of {', '.join(PROTOCOLS)}", "choose one of them"
        )
    return replace(PROTOCOLS[name].config, protocol=name, **changes)


def describe_protocol(config: EvaluationConfig) -> list[str]:
    """Returns sentences: the name of the protocol, its choices with their sources, and the settings that differ from
    it."""
    preset = PROTOCOLS[config.protocol]
    names = [field.name for field in fields(config) if field.name not in _NOT_IN_PROTOCOLS]
    changed = [name for name in names if getattr(config, name) != getattr(preset.config, name)]
    lines = [f"Protocol {config.protocol}: {preset.title}."]
    lines += [f"{choice} (source: {source})." for choice, source in preset.choices]
    if changed:
        lines.append(f"This run differs from the protocol {config.protocol} in: {', '.join(changed)}.")
    return lines


_NOT_IN_PROTOCOLS: Final = ("protocol", "quality", "threshold")
"""The fields of `EvaluationConfig` about which a protocol says nothing."""

_FILE: Final = Path(__file__).with_name("protocols.toml")


def _read_protocols() -> dict[str, ProtocolPreset]:
    protocols = {}
    for name, table in tomllib.loads(_FILE.read_text("utf-8")).items():
        title, choices = (
            table.pop("title"),
            tuple((choice, source) for choice, source in table.pop("choices")),
        )
        metrics = (*table.pop("metrics", DEFAULT_METRICS), *table.pop("additional_metrics", ()))
        protocols[name] = ProtocolPreset(title, choices, EvaluationConfig(metrics=metrics, **table))
    return protocols


PROTOCOLS: Final = _read_protocols()
"""name -> protocol, for `brewster evaluate --protocol`; the content of protocols.toml."""
