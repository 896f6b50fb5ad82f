"""The pedigree of a testbed's numbers: where each is from, how sure it is, and how those that were fitted vary."""

from __future__ import annotations

from dataclasses import dataclass

from vtbdrake.common.settings import check_settings, setting

SOURCES = ("assumed", "datasheet", "measured", "calibrated")


@dataclass(kw_only=True)
class Number:
    """A number of a testbed, or an array of them, by its address."""

    source: str = setting("assumed", "Where it is from; what has no entry is assumed.", choices=SOURCES)
    value: float | None = setting(None, "The value in s0; None: the scenario's value without this entry.")
    deviation: float | None = setting(None, "Its standard deviation, if it is known.", ge=0)
    lower: float | None = setting(None, "The lower end of its interval of 95 %.")
    upper: float | None = setting(None, "The upper end of its interval of 95 %.")
    note: str = setting("", "Document, instrument or verdict.")

    def __post_init__(self) -> None:
        check_settings(self)


@dataclass(kw_only=True)
class Posterior:
    """The joint distribution of numbers that were fitted together: normal, within ranges.

    Its numbers are single ones, and ten (`vtbdrake.testbed.inertia.pseudo_inertia`) for each body whose inertia
    was fitted as a whole, so that every sample is a body of positive masses.
    """

    addresses: list[str] = setting(default_factory=list, doc="The addresses of the single numbers.")
    inertias: list[str] = setting(default_factory=list, doc="The addresses of the bodies.")
    mean: list[float] = setting(default_factory=list, doc="The estimate, of the numbers and then of the bodies.")
    covariance: list[list[float]] = setting(default_factory=list, doc="Its covariance.")
    lower: list[float] = setting(default_factory=list, doc="The least single numbers.")
    upper: list[float] = setting(default_factory=list, doc="The largest single numbers.")
    disturbances: dict[str, float] = setting(
        default_factory=dict,
        doc="What nothing in the model explains: deviations and correlation time of random torques, by address.",
    )
    seed: str = setting("", "The address of the seed of these torques.")


@dataclass(kw_only=True, repr=False)
class Pedigree:
    """The pedigree of the numbers of a testbed. Those with a value begin with it: it is the default of their variable.

    Only the values are part of the identity of a scenario.
    """

    numbers: dict[str, Number] = setting(default_factory=dict, doc="The numbers, by address.")
    posterior: Posterior = setting(default_factory=Posterior, doc="How those that were fitted vary together.")
    logs: dict[str, str] = setting(default_factory=dict, doc="SHA-256 of the recordings of the fit, by their source.")
    reasons: list[str] = setting(default_factory=list, doc="Why the fit is not accepted.")
    domain: str = setting("", "The file of the validity domain, beside the scenario's file.")

    def __repr__(self) -> str:
        sources = [number.source for number in self.numbers.values()]
        return f"<pedigree of {', '.join(f'{sources.count(s)} {s}' for s in SOURCES if s in sources) or 'no'} numbers>"

    @property
    def values(self) -> dict[str, float]:
        """Return the values that s0 begins with, by address."""
        return {address: each.value for address, each in self.numbers.items() if each.value is not None}
