"""The named protocols: their settings, their sources, and what a report says about them."""

from brewster.cli.evaluate import evaluate
from brewster.evaluate.config import PROTOCOLS, describe_protocol, protocol_config


def test_a_changed_setting_is_named():
    lines = describe_protocol(protocol_config("xreflection", short_side_px=None, quality="draft"))
    assert lines[-1] == "This run differs from the protocol xreflection in: short_side_px."


def test_the_command_offers_all_protocols():
    (option,) = (option for option in evaluate.params if option.name == "protocol")
    assert [name.lower() for name in option.type.choices] == [*PROTOCOLS]
