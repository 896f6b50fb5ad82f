"""Maps that are revised on the way: a map that is out of date, and a drive out of the mapped area and back.

``python -m vtbdrake_diagrams.forest.studies.revised_maps [--scanned N]`` localizes the same drives with a unit that
revises its map (`Tracker.revises`) and with one that does not. What is in `FILE` is not driven again.

*Out of date.* A carrier drives `LENGTH` m through a forest. Its map lacks `OUTDATED` of the trees, and as large a share
of its entries are trees that are gone, with the errors of position of `DEVIATIONS`. A trunk or an entry counts as
passed within `PASSED` m of the path. In `FORESTS` forests detections are simulated (`detections`); in the first ones,
as many as ``--scanned`` says, a carrier is simulated with its scanner and its tyres, and drives `SCANNED` m.

*Out and back.* A carrier drives a whole circle with simulated detections. Its map shows the half where it starts: the
circle leaves the mapped half after a quarter, and comes back after three. The carrier is out while no entry of the map
is within the reach of the detector. Dead reckoning alone goes on from the pose at which it gets out.

The criteria, fixed before any of the forests from `SEED` on was driven: the error of the position, RMS over the scans
with a pose, and its median over the forests; the share of scans with a pose; wrong claims, which are off by more than
`WRONG` m and by more than three deviations; the shares of the added and of the dropped landmarks that are right, within
`RIGHT` m, and of the passed ones that are noticed; the NEES of the last poses, and of all right added landmarks of a
drive together, with their joint covariance. Revision must not make poses worse (`is_no_worse`): it has no more wrong
claims, not fewer poses, and a median of the errors of at most `LARGEST_RATIO` times the one without. `LEAST_SHARE` of
what is added and dropped must be right, and of what is passed be noticed. Out of the mapped area, it must err less than
dead reckoning, and back in it the landmarks from outside must be nearer to the truth than before.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import click
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2
from threadpoolctl import threadpool_limits

from vtbdrake.cli.output import table
from vtbdrake.common.arrays import Array, Indices, rms
from vtbdrake.components.localization.constellation import ConstellationMap
from vtbdrake.components.localization.landmarks import Landmarks, map_landmarks
from vtbdrake.components.localization.planar import compose, inverse
from vtbdrake.components.localization.tracking import Tracker
from vtbdrake.components.localization.unit import LocalizationUnit, UnitState
from vtbdrake_diagrams.forest.studies.detections import Detector, Wood
from vtbdrake_diagrams.forest.studies.drive import Drive, Track, memories, recorded_drive, simulated_drive, track_of
from vtbdrake_diagrams.forest.studies.drives import DENSITIES, forest, nees_bounds
from vtbdrake_diagrams.forest.world.stand import Stand
from vtbdrake_diagrams.kept_results import read_results, write_results
from vtbdrake_diagrams.processes import in_processes

SEED = 720_000
"""The seed of the first forest. No constant of the revision may be chosen with forests from this seed on."""
FORESTS = 20
"""The number of forests with simulated detections."""
LENGTH = 30.0
"""The length of the drives with a map that is out of date, in m."""
SCANNED = 20.0
"""The length of these drives with the simulated scanner, in m."""
OUTDATED = 0.2
"""The share of the trees that the map lacks, and of its entries that are gone."""
DEVIATIONS = {"accurate": (0.10, 0.05), "remote": (0.35, 0.20)}
"""Standard deviations of the positions in m, per axis, and of the diameters as a share, by the name of the map."""
SPACING = 1.0
"""Least distance in m of a tree that is gone from those that stand, as in a `Stand`."""
PASSED = 10.0
"""Trees and entries within this distance of the path are passed, in m."""
RIGHT = 0.5
"""The largest distance of an added landmark from the tree that it shows, in m."""
WRONG = 0.5
"""The least error of a wrong claim in m."""
LEAST_SHARE = 0.9
"""The least share of right changes, and of noticed ones."""
LARGEST_RATIO = 1.05
"""The largest median of the errors over the median without revision that counts as no worse."""
SIZE = 80.0
"""The edge of the stands with simulated detections, in m."""
MIDDLE = np.array([0.5 * SIZE, 0.5 * SIZE])
"""The middle of these stands, in m."""
DETECTOR = Detector(reach=15.0, false=0.2)
"""The detector of simulated detections: a fifth of the trunks are no trees, which no map shows."""
SEARCHED = (10.0, 10.0)
"""The distance in m and the time in s between attempts of a unit without a pose, on the way out and back."""
MOST = 1000
"""The largest number of landmarks in the state of a drive out and back: all of them."""
FILE = Path(__file__).with_suffix(".json")
"""The file in which the results are kept."""


@dataclass(frozen=True, eq=False)
class Survey:
    """A map that is out of date, and what is true.

    Attributes:
        landmarks: The map.
        shown: The trunk that each entry shows, -1 for those that are gone, (n,).
        trunks: The true positions of all trunks in W in m, (m, 2).
    """

    landmarks: Landmarks
    shown: Indices
    trunks: Array

    @property
    def lacking(self) -> Indices:
        """The trunks that the map does not show."""
        return np.setdiff1d(np.arange(len(self.trunks)), self.shown)

    @property
    def gone(self) -> Indices:
        """The entries that are gone."""
        return np.flatnonzero(self.shown < 0)


def surveyed(
    trunks: Landmarks, shown: Indices, *, gone: int, area: float, name: str, rng: np.random.Generator
) -> Survey:
    """Return a map of some trunks, and of others that are gone.

    Args:
        trunks: The true trunks, in W.
        shown: The indices of the trunks that are on the map.
        gone: The number of entries that are gone; they stood apart from the others, with diameters of theirs.
        area: The edge of the square from (0, 0) in which these stood, in m.
        name: The name of the map in `DEVIATIONS`.
        rng: The generator of the random numbers.
    """
    deviation, share = DEVIATIONS[name]
    candidates = rng.random((20 * gone, 2)) * area
    stood = candidates[cKDTree(trunks.positions).query(candidates)[0] > SPACING][:gone]
    places = np.vstack([trunks.positions[shown], stood])
    sizes = np.concatenate([trunks.diameters[shown], rng.choice(trunks.diameters, gone)])
    n = len(places)
    landmarks = Landmarks(
        places + deviation * rng.normal(size=places.shape),
        np.tile(deviation**2 * np.eye(2), (n, 1, 1)),
        sizes * np.maximum(1.0 + share * rng.normal(size=n), 0.1),
        share * sizes,
    )
    return Survey(landmarks, np.concatenate([shown, np.full(gone, -1)]), trunks.positions)


@dataclass(frozen=True)
class Outdated:
    """The results of one drive with a map that is out of date.

    Attributes:
        map: The name of the map.
        revises: Whether the map is revised.
        rms: RMS error of the position in m.
        poses: The share of the scans with a pose.
        losses: The number of times that the pose was lost.
        wrong: The number of wrong claims.
        nees: NEES of the last pose, of 3 degrees of freedom.
        added: The numbers of landmarks that are added, and of right ones.
        lacking: The numbers of passed trees that the map lacks, and of those that are added.
        dropped: The numbers of entries that are dropped, and of those that are gone.
        gone: The numbers of passed entries that are gone, and of those that are dropped.
        moved: The numbers of landmarks that are moved, and of those that show the trunk of their entry.
        landmarks: The joint NEES of the right added landmarks, and its degrees of freedom.
        landmark_error: RMS error of these in m; 0 of none.
    """

    map: str
    revises: bool
    rms: float
    poses: float
    losses: int
    wrong: int
    nees: float
    added: tuple[int, int]
    lacking: tuple[int, int]
    dropped: tuple[int, int]
    gone: tuple[int, int]
    moved: tuple[int, int]
    landmarks: tuple[float, int]
    landmark_error: float


@dataclass(frozen=True)
class OutAndBack:
    """The results of one drive out of the mapped area and back.

    Attributes:
        revises: Whether the map is revised.
        poses: The share of the scans with a pose.
        out_poses: The share of the scans with a pose while the carrier is out.
        losses: The number of times that the pose was lost.
        wrong: The number of wrong claims.
        out: The distance travelled while the carrier is out, in m.
        reckoned: The error of the position by dead reckoning alone at the end of the way out, in m.
        error: The error of the position there in m; None without a pose.
        deviation: The standard deviation of the position that the unit claims there in m, of both axes.
        back: The error of the position at the end of the drive in m; None without a pose.
        nees: NEES of the poses at the end of the way out and at the end of the drive; None without poses.
        landmarks: RMS errors in m of the landmarks that were added outside, at the end of the way out, before the
            landmarks of the map are seen again, and at the end of the drive; None without landmarks.
        landmark_nees: The joint NEES of these at the end of the drive, and its degrees of freedom.
        added: The numbers of landmarks that are added, and of right ones.
    """

    revises: bool
    poses: float
    out_poses: float
    losses: int
    wrong: int
    out: float
    reckoned: float
    error: float | None
    deviation: float | None
    back: float | None
    nees: tuple[float, float] | None
    landmarks: tuple[float, float] | None
    landmark_nees: tuple[float, int]
    added: tuple[int, int]


Case = Outdated | OutAndBack
Results = Mapping[str, Mapping[int, Sequence[Case]]]
"""The results by kind of drive, see `KINDS`, and seed."""


def wrong_claims(track: Track) -> int:
    """Return the number of poses that are off by more than `WRONG` m and by more than three deviations."""
    places = track.errors[:, :2]
    inverses = np.linalg.inv(track.covariances[track.is_localized][:, :2, :2])
    squares = np.einsum("ni,nij,nj->n", places, inverses, places)
    return int(((np.hypot(*places.T) > WRONG) & (squares > 9.0)).sum())


def added_trunks(state: UnitState, unit: LocalizationUnit, survey: Survey) -> tuple[int, Indices, Indices]:
    """Return the number of added landmarks, the right ones as rows of the state, and the trunks that these show."""
    changes, lacking = unit.tracker.changes(state.track), survey.lacking
    if not len(changes.added) or not len(lacking):
        return len(changes.added), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp)
    distances, nearest = cKDTree(survey.trunks[lacking]).query(changes.added.positions)
    is_right = distances < RIGHT
    rows = cKDTree(state.track.landmark_positions).query(changes.added.positions[is_right])[1]
    return len(changes.added), rows, lacking[nearest[is_right]]


def stands_alone(survey: Survey, trunks: Indices) -> NDArray[np.bool_]:
    """Return whether no other trunk is nearer than `RIGHT`, (k,): else a detection does not tell which it shows."""
    is_alone: NDArray[np.bool_] = cKDTree(survey.trunks).query(survey.trunks[trunks], k=2)[0][:, 1] > RIGHT
    return is_alone


def joint_nees(state: UnitState, rows: Indices, places: Array, *, lasting: float) -> tuple[float, int]:
    """Return the joint NEES of landmarks in the state, and its degrees of freedom.

    Args:
        state: The memory of the unit.
        rows: The landmarks as rows of the state, (k,).
        places: Their true positions in W in m, (k, 2).
        lasting: See `Tracker.lasting_deviation`, in m.
    """
    if not len(rows):
        return 0.0, 0
    track = state.track
    errors = (track.landmark_positions[rows] - places).ravel()
    columns = track.landmark_columns(rows).ravel()
    P = track.covariance[np.ix_(columns, columns)] + lasting**2 * np.eye(len(columns))
    return float(errors @ np.linalg.solve(P, errors)), len(errors)


def _passed(path: Array, places: Array) -> Indices:
    return np.flatnonzero(cKDTree(path).query(places)[0] < PASSED)


def stand_and_drive(seed: int, *, length: float, scans: float) -> tuple[Wood, Drive, np.random.Generator]:
    """Return the trunks of a stand, a drive through it with simulated detections, and random numbers for its map."""
    rng = np.random.default_rng([seed, 13])
    stand = Stand(seed=seed, length=SIZE, width=SIZE, density=float(rng.uniform(*DENSITIES)))
    drive = simulated_drive(stand, seed=seed, length=length, detector=DETECTOR, scans=scans)
    # The drive draws its false trunks first.
    return Wood.of(stand, false=DETECTOR.false, rng=np.random.default_rng([seed, 8])), drive, rng


def outdated(seed: int) -> list[Outdated]:
    """Drive with simulated detections and maps that are out of date, with and without revision."""
    wood, drive, rng = stand_and_drive(seed, length=LENGTH, scans=2.5)
    cases = []
    for name in DEVIATIONS:
        survey = outdated_survey(wood.trunks, np.flatnonzero(wood.is_tree), area=SIZE, name=name, rng=rng)
        for revises in (False, True):
            # Simulated detections have no errors in common.
            tracker = Tracker(survey.landmarks, revises=revises, lasting_deviation=0.0)
            unit = LocalizationUnit(ConstellationMap(survey.landmarks), tracker)
            cases.append(outdated_case(drive, unit, survey, name=name))
    return cases


def outdated_scanned(seed: int) -> list[Outdated]:
    """Drive with the simulated scanner and maps that are out of date, with and without revision."""
    scenario = forest(seed)
    drive = recorded_drive(scenario, length=SCANNED)
    model, rng = scenario.truth(), np.random.default_rng([seed, 12])
    trees, cases = map_landmarks(model), []
    for name in DEVIATIONS:
        survey = outdated_survey(trees, np.arange(len(trees)), area=scenario.length, name=name, rng=rng)
        for revises in (False, True):
            unit = replace(scenario, revises_map=revises).unit(model)
            tracker = replace(unit.tracker, landmarks=survey.landmarks)
            unit = replace(unit, locator=ConstellationMap(survey.landmarks), tracker=tracker)
            cases.append(outdated_case(drive, unit, survey, name=name))
    return cases


def outdated_survey(trunks: Landmarks, trees: Indices, *, area: float, name: str, rng: np.random.Generator) -> Survey:
    """Return a map that lacks `OUTDATED` of the trees, which are some of the trunks, and has as large a share gone."""
    shown = np.sort(rng.permutation(trees)[: round((1.0 - OUTDATED) * len(trees))])
    gone = round(len(shown) * OUTDATED / (1.0 - OUTDATED))
    return surveyed(trunks, shown, gone=gone, area=area, name=name, rng=rng)


def outdated_case(drive: Drive, unit: LocalizationUnit, survey: Survey, *, name: str) -> Outdated:
    """Localize a drive with a map that is out of date."""
    states = list(memories(drive, unit))
    track, last = track_of(drive, [state.answer for state in states]), states[-1]
    added, rows, trunks = added_trunks(last, unit, survey)
    changes = unit.tracker.changes(last.track)
    is_alone = stands_alone(survey, trunks)
    dropped, origins = changes.gone, survey.shown[changes.origins]
    is_same = np.hypot(*(changes.moved.positions - survey.trunks[origins]).T) < RIGHT
    path = drive.truth[:, :2]
    lacking = survey.lacking[_passed(path, survey.trunks[survey.lacking])]
    passed = survey.gone[_passed(path, survey.landmarks.positions[survey.gone])]
    errors = np.hypot(*(last.track.landmark_positions[rows] - survey.trunks[trunks]).T) if len(rows) else np.zeros(1)
    return Outdated(
        map=name,
        revises=unit.tracker.revises,
        rms=rms(np.hypot(*track.errors[:, :2].T)),
        poses=float(track.is_localized.mean()),
        losses=track.losses,
        wrong=wrong_claims(track),
        nees=float(track.nees[-1]),
        added=(added, len(rows)),
        lacking=(len(lacking), int(np.isin(lacking, trunks).sum())),
        dropped=(len(dropped), int(np.isin(dropped, survey.gone).sum())),
        gone=(len(passed), int(np.isin(passed, dropped).sum())),
        moved=(len(origins), int((is_same & (origins >= 0)).sum())),
        landmarks=joint_nees(
            last, rows[is_alone], survey.trunks[trunks[is_alone]], lasting=unit.tracker.lasting_deviation
        ),
        landmark_error=rms(errors),
    )


def out_and_back(seed: int) -> list[OutAndBack]:
    """Drive on a circle through a stand with a map of one half, with and without revision."""
    # One scan per metre, as the state is large.
    wood, drive, rng = stand_and_drive(seed, length=2.0 * np.pi * SIZE / 3.0, scans=1.0)
    is_here = (wood.trunks.positions - MIDDLE) @ (drive.truth[0, :2] - MIDDLE) > 0.0
    shown = np.flatnonzero(wood.is_tree & is_here)
    survey = surveyed(wood.trunks, shown, gone=0, area=SIZE, name="accurate", rng=rng)
    return [out_and_back_case(drive, survey, revises=revises) for revises in (False, True)]


def out_and_back_case(drive: Drive, survey: Survey, *, revises: bool) -> OutAndBack:
    """Localize a drive that leaves the mapped area and comes back."""
    distances = cKDTree(survey.landmarks.positions).query(drive.truth[:, :2])[0]
    out = np.flatnonzero(distances > DETECTOR.reach)
    first, end = int(out[0]), int(out[-1])
    # Simulated detections have no errors in common.
    tracker = Tracker(survey.landmarks, revises=revises, most=MOST, lasting_deviation=0.0)
    unit = LocalizationUnit(ConstellationMap(survey.landmarks), tracker, try_every=SEARCHED)
    answers, there = [], unit.start()
    for k, state in enumerate(memories(drive, unit)):
        answers.append(state.answer)
        if k == end:
            there = state
    track = track_of(drive, answers)
    motion = compose(inverse(drive.reckoned[first]), drive.reckoned[end])
    # The poses are near the truth where the carrier gets out.
    begin = track.poses[first] if track.is_localized[first] else drive.truth[first]
    errors = np.where(track.is_localized, np.hypot(*(track.poses - drive.truth)[:, :2].T), np.nan)
    squares = np.full(len(errors), np.nan)
    squares[track.is_localized] = track.nees
    added, rows, trunks = added_trunks(state, unit, survey)
    is_outside = (survey.trunks[trunks] - MIDDLE) @ (drive.truth[0, :2] - MIDDLE) < 0.0
    # Landmarks that the state has at both times.
    before = _rows_in(there, state, rows)
    is_both = (before >= 0) & is_outside & stands_alone(survey, trunks)
    has_poses = track.is_localized[end] and track.is_localized[-1]
    return OutAndBack(
        revises=revises,
        poses=float(track.is_localized.mean()),
        out_poses=float(track.is_localized[first : end + 1].mean()),
        losses=track.losses,
        wrong=wrong_claims(track),
        out=float(drive.travelled[end] - drive.travelled[first]),
        reckoned=float(np.hypot(*(compose(begin, motion) - drive.truth[end])[:2])),
        error=float(errors[end]) if track.is_localized[end] else None,
        deviation=float(np.sqrt(np.trace(track.covariances[end][:2, :2]))) if track.is_localized[end] else None,
        back=float(errors[-1]) if track.is_localized[-1] else None,
        nees=(float(squares[end]), float(squares[-1])) if has_poses else None,
        landmarks=_landmark_errors(there, state, before[is_both], rows[is_both], survey.trunks[trunks[is_both]])
        if is_both.any()
        else None,
        landmark_nees=joint_nees(state, rows[is_both], survey.trunks[trunks[is_both]], lasting=0.0),
        added=(added, len(rows)),
    )


def _rows_in(there: UnitState, state: UnitState, rows: Indices) -> Indices:
    """Return the rows in an earlier state of landmarks of a state, (k,); -1 where it does not have them."""
    row_of = {int(identity): row for row, identity in enumerate(there.track.indices)}
    return np.array([row_of.get(int(identity), -1) for identity in state.track.indices[rows]], dtype=np.intp)


def _landmark_errors(
    there: UnitState, state: UnitState, before: Indices, rows: Indices, places: Array
) -> tuple[float, float]:
    """Return the RMS errors in m of landmarks in an earlier state and in a state."""
    earlier, later = there.track.landmark_positions[before], state.track.landmark_positions[rows]
    return rms(np.hypot(*(earlier - places).T)), rms(np.hypot(*(later - places).T))


KINDS: Mapping[str, tuple[Callable[[int], Sequence[Case]], type[Case]]] = {
    "out of date": (outdated, Outdated),
    "out and back": (out_and_back, OutAndBack),
    "out of date, scanner": (outdated_scanned, Outdated),
}
"""The kinds of drives: the functions that drive in the forest of a seed, and the classes of their results."""


@dataclass(frozen=True)
class Driven:
    """The function of worker processes: the results of a kind of drive in the forest of a seed."""

    kind: str

    def __call__(self, seed: int) -> Sequence[Case]:
        # One thread: matrices are small, and threads that wait for each other take most of the time.
        with threadpool_limits(1):
            return KINDS[self.kind][0](seed)


def _share(counts: Sequence[tuple[int, int]]) -> tuple[int, float]:
    """Return the sum of the totals, and the share of the parts in them; NaN of none."""
    total, part = np.array(counts).sum(axis=0)
    return int(total), float(part / total) if total else np.nan


def median(values: Sequence[float | None]) -> float:
    """Return the median of the values that are not None; NaN of none."""
    finite = [value for value in values if value is not None]
    return float(np.median(finite)) if finite else np.nan


def _joint(values: Sequence[tuple[float, int]]) -> tuple[float, tuple[float, float]]:
    """Return the sum of joint NEES over the sum of their degrees of freedom, and its 95 % bounds."""
    total, freedom = np.array(values).sum(axis=0)
    if not freedom:
        return np.nan, (0.0, np.inf)
    low, high = (chi2(freedom).ppf([0.025, 0.975]) / freedom).tolist()
    return float(total / freedom), (low, high)


def outdated_cases(results: Results, kind: str, name: str, *, revises: bool) -> list[Outdated]:
    """Return the results of drives of a kind with a map of this name."""
    cases = [case for by_seed in results[kind].values() for case in by_seed]
    return [c for c in cases if isinstance(c, Outdated) and (c.map, c.revises) == (name, revises)]


def return_cases(results: Results, *, revises: bool) -> list[OutAndBack]:
    """Return the results of drives out and back."""
    cases = [case for by_seed in results["out and back"].values() for case in by_seed]
    return [c for c in cases if isinstance(c, OutAndBack) and c.revises == revises]


def is_no_worse(fixed: Sequence[Outdated], revised: Sequence[Outdated]) -> bool:
    """Return whether revision makes poses no worse: errors, shares of poses, and wrong claims."""
    errors = [median([case.rms for case in cases]) for cases in (fixed, revised)]
    poses = [np.mean([case.poses for case in cases]) for cases in (fixed, revised)]
    wrong = [sum(case.wrong for case in cases) for cases in (fixed, revised)]
    return bool(errors[1] <= LARGEST_RATIO * errors[0] and poses[1] >= poses[0] and wrong[1] <= wrong[0])


def changes_right(revised: Sequence[Outdated]) -> bool:
    """Return whether enough of the changes are right, and enough of what is passed is noticed."""
    names = ("added", "lacking", "dropped", "gone")
    return all(_share([getattr(case, name) for case in revised])[1] >= LEAST_SHARE for name in names)


def returns_well(revised: Sequence[OutAndBack]) -> bool:
    """Return whether poses outside are better than by dead reckoning, and landmarks are corrected on the way back."""
    errors, reckoned = ([getattr(case, name) for case in revised] for name in ("error", "reckoned"))
    before, after = ([case.landmarks and case.landmarks[k] for case in revised] for k in (0, 1))
    is_complete = None not in errors and None not in before
    return is_complete and median(errors) < median(reckoned) and median(after) < median(before)


def report(results: Results) -> str:
    """Return the tables of all kinds, and whether the criteria hold."""
    lines = []
    header = ("map", "revised", "error m", "poses", "lost", "wrong", "NEES", "95 %", "added: right", "of lacking")
    header = (*header, "dropped: right", "of gone", "moved: right", "error of added m", "their NEES", "95 % ")
    for kind in ("out of date", "out of date, scanner"):
        rows, verdicts = [], []
        for name in DEVIATIONS if results[kind] else ():
            fixed, revised = (outdated_cases(results, kind, name, revises=revises) for revises in (False, True))
            rows += [_outdated_row(name, fixed), _outdated_row(name, revised)]
            verdict = f"no worse: {_word(is_no_worse(fixed, revised))}, changes: {_word(changes_right(revised))}"
            verdicts.append(f"{name} map: {verdict}")
        lines += [f"{kind}, {len(results[kind])} forests", *([table(header, rows)] if rows else []), *verdicts]
    there_and_back = [return_cases(results, revises=revises) for revises in (False, True)]
    header = ("revised", "poses", "out", "lost", "wrong", "out: reckoned m", "error m", "largest", "claimed", "NEES")
    header = (*header, "back: m", "NEES ", "95 %", "landmarks: before m", "after m", "their NEES", "95 % ")
    lines += [f"out and back, {len(there_and_back[0])} forests"]
    if there_and_back[0]:
        lines += [table(header, [_return_row(cases) for cases in there_and_back])]
        lines += [f"out and back: {_word(returns_well(there_and_back[1]))}"]
    return "\n".join(lines)


def _word(holds: bool) -> str:
    return "yes" if holds else "NO"


def _outdated_row(name: str, cases: Sequence[Outdated]) -> tuple[str, ...]:
    revises = cases[0].revises
    low, high = nees_bounds(len(cases))
    shares = [
        _share([getattr(case, each) for case in cases]) for each in ("added", "lacking", "dropped", "gone", "moved")
    ]
    joint, (least, largest) = _joint([case.landmarks for case in cases])
    return (
        name,
        _word(revises).lower(),
        f"{median([case.rms for case in cases]):.3f}",
        f"{np.mean([case.poses for case in cases]):.1%}",
        str(sum(case.losses for case in cases)),
        str(sum(case.wrong for case in cases)),
        f"{np.mean([case.nees for case in cases]):.2f}",
        f"{low:.2f} to {high:.2f}",
        *(f"{share:.0%} of {total}" if revises else "-" for total, share in shares),
        f"{median([case.landmark_error for case in cases]):.3f}" if revises else "-",
        f"{joint:.2f}" if revises else "-",
        f"{least:.2f} to {largest:.2f}" if revises else "-",
    )


def _return_row(cases: Sequence[OutAndBack]) -> tuple[str, ...]:
    with_poses = [case for case in cases if case.nees is not None]
    low, high = nees_bounds(len(with_poses))
    joint, (least, largest) = _joint([case.landmark_nees for case in cases])
    errors = [case.error for case in cases if case.error is not None]
    nees = [f"{np.mean([case.nees[k] for case in with_poses if case.nees]):.2f}" if with_poses else "-" for k in (0, 1)]
    return (
        _word(cases[0].revises).lower(),
        f"{np.mean([case.poses for case in cases]):.1%}",
        f"{np.mean([case.out_poses for case in cases]):.1%}",
        str(sum(case.losses for case in cases)),
        str(sum(case.wrong for case in cases)),
        f"{median([case.reckoned for case in cases]):.3f}",
        f"{median(errors):.3f}",
        f"{max(errors, default=np.nan):.3f}",
        f"{median([case.deviation for case in cases]):.3f}",
        nees[0],
        f"{median([case.back for case in cases]):.3f}",
        nees[1],
        f"{low:.2f} to {high:.2f}",
        *(f"{median([case.landmarks and case.landmarks[k] for case in cases]):.3f}" for k in (0, 1)),
        f"{joint:.2f}",
        f"{least:.2f} to {largest:.2f}",
    )


def in_words(results: Results) -> str:
    """Return the gain of a unit that revises its map, in a few sentences."""
    fixed, revised = (outdated_cases(results, "out of date", "accurate", revises=revises) for revises in (False, True))
    there_and_back = return_cases(results, revises=True)
    errors = [f"{median([case.rms for case in cases]):.3f} m" for cases in (revised, fixed)]
    right = [f"{_share([getattr(case, name) for case in revised])[1]:.0%}" for name in ("added", "dropped")]
    out = [f"{median([getattr(case, name) for case in there_and_back]):.2f} m" for name in ("error", "reckoned")]
    return (
        f"A unit that revises an accurate map, where a fifth is lacking and a fifth gone, errs by {errors[0]} in "
        f"{len(revised)} other forests ({errors[1]} without revision; medians); {right[0]} of what it adds and "
        f"{right[1]} of what it drops is right. On a way out of the mapped area it errs by {out[0]}, dead reckoning "
        f"alone by {out[1]}."
    )


def load() -> dict[str, dict[int, Sequence[Case]]]:
    """Return the results that are kept in `FILE`.

    Raises:
        KeptResultsError: It is missing, or was changed.
    """
    return {
        kind: {int(seed): [KINDS[kind][1](**case) for case in cases] for seed, cases in by_seed.items()}
        for kind, by_seed in read_results(FILE).items()
    }


@click.command(context_settings={"show_default": True})
@click.option("--scanned", default=4, help="Number of forests with the simulated scanner.")
@click.option("--workers", default=2, help="Number of processes.")
def main(scanned: int, workers: int) -> None:
    """Drive through the forests that the file lacks, and print the tables of all."""
    results: dict[str, dict[int, Sequence[Case]]] = {kind: {} for kind in KINDS}
    if FILE.exists():
        results |= load()
    for kind, by_seed in results.items():
        count = scanned if kind == "out of date, scanner" else FORESTS
        seeds = [seed for seed in range(SEED, SEED + count) if seed not in by_seed]
        for seed, cases in in_processes(Driven(kind), seeds, workers=workers):
            by_seed[seed] = cases
            write_results(FILE, results, command="python -m vtbdrake_diagrams.forest.studies.revised_maps")
            print(f"{kind}: {len(by_seed)} forests", flush=True)
    print(report(results))


if __name__ == "__main__":
    # Under its own name, so that worker processes find its classes.
    from vtbdrake_diagrams.forest.studies.revised_maps import main as program

    program()
