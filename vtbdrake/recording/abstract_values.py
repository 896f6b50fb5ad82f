"""The values of abstract sensor signals, out of the raw messages of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from vtbdrake.lcm.maps import Reader
from vtbdrake.lcm.protocol import protocol_of
from vtbdrake.recording.control_log import ControlLog
from vtbdrake.recording.log_format import LogError
from vtbdrake.testbed.addressed import AddressedDiagram


def abstract_values(log: ControlLog, target: AddressedDiagram) -> Mapping[str, Callable[[int], Any]]:
    """By abstract sensor signal, what makes the value of the number of the event with its message.

    Raises:
        LogError: nobody says how to decode the messages, or they are not in the log.
        ProtocolError: the scenario does not say what its machine speaks.
    """
    signals = {signal.name: signal for signal in target.interface.sense}
    abstract = [name for name, signal in signals.items() if not signal.is_vector]
    if not abstract:
        return {}
    if target.scenario is None:
        raise LogError(f"no scenario says how the messages of {', '.join(abstract)} are decoded")
    found = {}
    for map in protocol_of(target.scenario).sense:
        reader = map.reader([signals[name] for name in map.signals])
        for name in map.signals:
            if name in abstract:
                found[name] = _values(log, map.channel, reader, name)
    return found


def _values(log: ControlLog, channel: str, reader: Reader, name: str) -> Callable[[int], Any]:
    places = {number: (begin, end) for number, _, begin, end in log.events.on(channel)}

    def value(event: int) -> Any:
        if event not in places:
            raise LogError(f"the message with the value of {name}, event {event} on {channel}, is not in {log.path}")
        return reader(log.events.data(*places[event])).values[name]

    return value
