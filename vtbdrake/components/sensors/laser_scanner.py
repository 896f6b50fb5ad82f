"""3D laser scanners, whose rays are fired one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import lru_cache
from math import inf, pi, sqrt
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialVelocity
from pydrake.systems.framework import (
    AbstractStateIndex,
    Context,
    EventStatus,
    State,
)

from vtbdrake.common.arrays import Array, immutable
from vtbdrake.common.scan import Scan
from vtbdrake.common.settings import check_settings, declared_settings, setting
from vtbdrake.components.environment.haze import HAZE, false_return_ranges, two_way_transmission
from vtbdrake.components.perception.estimate import rotation_matrix
from vtbdrake.components.sensors.errors import ErrorModel
from vtbdrake.components.sensors.noise import noise_generator, random_stream
from vtbdrake.components.sensors.sampled import SampledValues
from vtbdrake.state import AddressedSystem, Codec, Quantity
from vtbdrake.state.systems import POSE_UNIT, pose_from_array, pose_to_array

if TYPE_CHECKING:
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import Frame
    from pydrake.systems.framework import DiagramBuilder

    from vtbdrake.components.environment import Haze
    from vtbdrake.components.ray_casting import RayCaster


# The largest difference in s of two instants that are equal but for rounding.
_ROUNDING = 1e-9
# The fields of an `ErrorModel` that ranges have.
_ERRORS = ("noise", "outlier_probability", "outlier_size", "bias", "quantization", "dropout", "seed")
# The output port.
_SCAN = "scan"
# The channel of the scanner's stream of random numbers.
_CHANNEL = 0


@dataclass(kw_only=True)
class LaserScannerConfig:
    """The configuration of a laser scanner. All values are parameters of the Context, too."""

    frequency: float = setting(10.0, "Scans per second.", unit="Hz", gt=0.0)
    rays_per_second: float = setting(
        20_000.0, "Rays per second; a scan has rays / frequency, rounded to whole rows.", unit="1/s", gt=0.0
    )
    azimuth: float = setting(0.7, "Width of the field of view about z_L.", unit="rad", gt=0.0, le=2.0 * pi)
    elevation: float = setting(0.5, "Height of the field of view; 0 scans one row.", unit="rad", ge=0.0, le=pi)
    rows: int = setting(
        0,
        "Number of beams, one above the other, that turn together about z_L, as in a spinning scanner; 0 for "
        "rows and columns at about equal angular distances, which are scanned row by row.",
        ge=0,
    )
    min_range: float = setting(0.2, "Measured distance below which nothing is reported.", unit="m", gt=0.0)
    max_range: float = setting(
        50.0,
        "Distance at which a white, perpendicular surface is just detected in clear space; above it nothing is "
        "reported.",
        unit="m",
        gt=0.0,
    )
    reflectivity: float = setting(0.5, "Share of the light that all surfaces reflect, diffusely.", ge=0.0, le=1.0)
    divergence: float = setting(
        0.0, "Full angle of the beam's divergence, where its intensity has fallen to 1/e^2.", unit="rad", ge=0.0, lt=0.5
    )

    def check(self, slice_period: float) -> None:
        """Check that all values are possible.

        Args:
            slice_period: Length of the scanner's slices, in s.

        Raises:
            ValueError: A value is outside of its range.
        """
        check_settings(self)
        most = 1.0 / slice_period + _ROUNDING
        rays = self.rays_per_second / self.frequency
        for name, is_possible, expected in (
            ("frequency", self.frequency <= most, f"at most {most:g} Hz, one scan per slice"),
            ("rays_per_second", rays >= 1.0, f"at least one ray per scan, {self.frequency:g} 1/s"),
            ("rows", self.rows <= rays, f"at most the {rays:g} rays of a scan"),
            ("max_range", self.max_range > self.min_range, f"above the min_range, {self.min_range:g} m"),
        ):
            if not is_possible:
                raise ValueError(f"LaserScannerConfig.{name} must be {expected}, not {getattr(self, name)!r}")


_FIELDS = tuple(field.name for field in fields(LaserScannerConfig))


@immutable
class _ScannerSettings:
    """The parameters as they are used."""

    X_BL: RigidTransform
    config: LaserScannerConfig
    errors: ErrorModel


@immutable
class ScanInProgress:
    """The returns of the present scan so far, by slice: arrays of direction (3), range (m) and time since its start."""

    slices: tuple[Array, ...] = ()

    def returns(self) -> Array:
        """Return all returns so far, shape (n, 5)."""
        return np.concatenate(self.slices) if self.slices else np.zeros((0, 5))


def _decode_progress(arrays: Mapping[str, np.ndarray]) -> ScanInProgress:
    return ScanInProgress((np.asarray(arrays["returns"]),))


_PROGRESS_CODEC = Codec(lambda progress: {"returns": progress.returns()}, _decode_progress)


class LaserScanner(AddressedSystem):
    r"""Measures distances along rays that it fires one after the other.

    .. pydrake_system::

        name: LaserScanner
        input_ports:
        - body_poses
        - body_spatial_velocities
        - haze (optional: of a `Haze`)
        output_ports:
        - scan

    ``scan`` is the last complete `Scan`, in the scanner's frame L (x forward, z up), stamped with the time of its end;
    before the first, an empty one, stamped 0. A scan has n rays at equal intervals of 1 / (n frequency), row by row
    from the top, each row from the right, where rows and columns have about the same angular distance. If ``rows`` is
    not 0, it is the number of beams, which scan column by column from the right, each column from the top. At first, L
    is ``frame`` on its body B; the parameter ``pose``, [x, y, z, roll, pitch, yaw] of L in B, moves it.

    The scanner is updated in slices of time. At the end of a slice, all rays are cast that were fired during it, each
    at the poses at its own firing time, which follow from poses and velocities at the end of the slice; velocities are
    assumed to be constant during it. So a moving target is distorted as in reality, with an error of up to a h^2 / 2 at
    an acceleration a in slices of length h. A scan is seen by the updates after the end of the slice in which it ends,
    as with a `SampledSensor`. The frequency need not divide the slices' frequency. Frequency, rays per second and rows
    may be changed at any time, and take effect with the next scan.

    A beam is reflected by a Lambertian surface at the distance r under the angle a of incidence. It is detected if the
    received power (Hoefle and Pfeifer, "Correction of laser scanning intensity data: data and
    model-driven approaches", 2007) reaches the power from a white, perpendicular surface at the largest range:

        reflectivity cos(a) exp(-2 b r) / r^2 >= 1 / max_range^2        (b: extinction of the haze)

    So a beam drops out at grazing incidence, the sooner the farther away the surface is. Haze adds false returns, see
    `false_return_ranges`. The return may come from anywhere in the beam's footprint: the beam is cast in a direction
    that differs from the reported one by normal errors of a quarter of the divergence about both axes (Lichti and
    Gordon, "Error propagation in directly georeferenced terrestrial laser scanner point clouds for cultural heritage
    recording", 2004). So the error of a range grows with distance and incidence, r tan(a) divergence / 4, and a ray
    beside an edge may hit either side. Ranges between the two sides (mixed pixels) do not occur.

    An `ErrorModel` adds noise, outliers, bias, quantization (all in m) and drop-out to the ranges, ray by ray. A range
    that is then below min_range or above max_range is not reported.

    The fields of `LaserScannerConfig`, ``pose``, ``noise``, ``outlier_probability``, ``outlier_size``, ``bias``,
    ``quantization``, ``dropout`` and ``seed`` are parameters. ``scan_start``, ``scan_period``, ``scan_rows``,
    ``scan_columns``, ``scan_by_columns`` and ``fired`` (rays) of the present scan are state.

    Attributes:
        optional_inputs: Names of the input ports that need not be connected.
    """

    optional_inputs: ClassVar[tuple[str, ...]] = ("haze",)

    def __init__(
        self,
        plant: MultibodyPlant,
        frame: Frame,
        caster: RayCaster,
        *,
        config: LaserScannerConfig | None = None,
        slice_period: float = 0.02,
        stream: int | None = None,
        errors: ErrorModel | None = None,
    ) -> None:
        """Declare the scanner.

        Args:
            plant: The plant, whose bodies move.
            frame: A frame of the plant: the initial frame L of the scanner.
            caster: The geometry that rays are cast at; several scanners can share it.
            config: Initial values of the parameters.
            slice_period: Length of a slice in s. It limits the frequency; shorter ones cost time.
            stream: Number of the random stream, as in `SampledSensor`.
            errors: Errors of the ranges, and the seed; None for exact ranges.

        Raises:
            ValueError: A value is outside of its range, or ``errors`` has a drift or a latency.
        """
        super().__init__()
        config, errors = config or LaserScannerConfig(), errors or ErrorModel()
        if not 0.0 < slice_period < inf:
            raise ValueError(f"LaserScanner: the slice_period is positive, in s, not {slice_period!r}")
        config.check(slice_period)
        check_settings(errors, name="LaserScanner.errors")
        for name in ("drift", "latency", "max_latency"):
            if getattr(errors, name):
                raise ValueError(f"LaserScanner: scans have no {name}; leave it out of the errors")
        self._caster, self._body = caster, int(frame.body().index())
        self.slice_period: float = float(slice_period)  # length of a slice in seconds
        self._stream = random_stream(self, stream)
        self._poses_port = self.DeclareAbstractInputPort("body_poses", Value[list[RigidTransform]]())
        self._velocities_port = self.DeclareAbstractInputPort("body_spatial_velocities", Value[list[SpatialVelocity]]())
        self._haze_port = self.DeclareVectorInputPort("haze", HAZE.size)
        self._declare_parameters(frame.GetFixedPoseInBodyFrame(), config, errors)
        self._declare_state()
        self.DeclarePeriodicUnrestrictedUpdateEvent(self.slice_period, 0.0, self._end_slice)

    def _declare_parameters(self, X_BL: RigidTransform, config: LaserScannerConfig, errors: ErrorModel) -> None:
        settings = declared_settings(ErrorModel) | declared_settings(LaserScannerConfig)
        units = {name: settings[name].unit or "1" for name in (*_FIELDS, *_ERRORS)}
        units |= dict.fromkeys(("noise", "outlier_size", "bias", "quantization"), "m")  # as the ranges
        bounds = {name: settings[name].bounds for name in units} | {"frequency": (0.0, 1.0 / self.slice_period)}
        defaults = {name: getattr(config, name) for name in _FIELDS} | {name: getattr(errors, name) for name in _ERRORS}
        self._parameters = self.declare_parameters(
            pose=Quantity(pose_to_array(X_BL), POSE_UNIT),
            **{name: Quantity(default, units[name], bounds[name]) for name, default in defaults.items()},
        )
        self._settings = self.declare_cache(
            "settings", self._calc_settings, {self.numeric_parameter_ticket(self._parameters.index)}
        )

    def _declare_state(self) -> None:
        self._scans = SampledValues(self, self.slice_period, {_SCAN: Scan.empty()})
        self._progress: AbstractStateIndex = self.DeclareAbstractState(Value(ScanInProgress()))
        self.codecs = {int(self._progress): _PROGRESS_CODEC}
        # The state of the present scan; with 0 rows, none has begun.
        self._present = self.declare_discrete_state(
            scan_start=Quantity(unit="s"),
            scan_period=Quantity(unit="s"),
            scan_rows=Quantity(),
            scan_columns=Quantity(),
            scan_by_columns=Quantity(),
            fired=Quantity(),
        )

    def points_W(self, context: Context) -> Array:
        """Return the points of the last scan in the world, each where its ray was fired, in m, shape (n, 3).

        The scanner is assumed to have moved with its present velocity since the scan began.
        """
        scan: Scan = self._scans.read(context, _SCAN)
        X_WL, V_WL = self._motion(context)
        ages = scan.stamp + scan.times - context.get_time()
        turns = rotation_matrix(np.outer(ages, V_WL.rotational()))
        points = np.einsum("nij,nj->ni", turns, scan.points() @ X_WL.rotation().matrix().T)
        return points + X_WL.translation() + np.outer(ages, V_WL.translational())

    def _motion(self, context: Context) -> tuple[RigidTransform, SpatialVelocity]:
        """Return X_WL and V_WL."""
        X_WB, V_WB = (port.Eval(context)[self._body] for port in (self._poses_port, self._velocities_port))
        X_BL = self._settings(context).X_BL
        return X_WB @ X_BL, V_WB.Shift(X_WB.rotation() @ X_BL.translation())

    def resume(self, context: Context, scan: Scan) -> None:
        """Set the last complete scan to ``scan``, and begin a new one.

        Args:
            context: The Context of this scanner, in the state of the world from which it continues.
            scan: The last complete scan.
        """
        self._scans.resume(context, _SCAN, scan)
        context.SetAbstractState(self._progress, ScanInProgress())
        context.SetDiscreteState(self._present.index, self._present.vector.array())

    def _calc_settings(self, context: Context) -> _ScannerSettings:
        values = self._parameters.view(context)
        config = LaserScannerConfig(**{name: getattr(values, name) for name in _FIELDS})
        if float(config.rows).is_integer():
            config.rows = int(config.rows)
        config.check(self.slice_period)
        errors = ErrorModel(**{name: getattr(values, name) for name in _ERRORS} | {"seed": int(values.seed)})
        return _ScannerSettings(pose_from_array(values.pose), config, errors)

    def _end_slice(self, context: Context, state: State) -> EventStatus:
        settings: _ScannerSettings = self._settings(context)
        now = context.get_time()
        present = self._present.mutable(state.get_mutable_discrete_state())
        start, period = present.scan_start, present.scan_period
        rows, columns, by_columns = int(present.scan_rows), int(present.scan_columns), bool(present.scan_by_columns)
        fired = int(present.fired)
        slices = context.get_abstract_state(int(self._progress)).get_value().slices
        # No scan has begun, or the context has been set to a later time.
        if not rows or start + (fired + 0.5) * period / (rows * columns) < now - 1.5 * self.slice_period:
            start, slices, fired = now, (), 0
            period, rows, columns, by_columns = _next_scan(settings.config)
        tick = round(now / self.slice_period)
        stream = self._stream() if self._is_random(context, settings) else 0
        generator = noise_generator(seed=int(settings.errors.seed), stream=stream, tick=tick, channel=_CHANNEL)
        while True:
            rays = rows * columns
            due = min(rays, int((now + _ROUNDING - start) / period * rays + 0.5))
            if due > fired:
                config = settings.config
                rays_L = raster(rows, columns, config.azimuth, config.elevation, by_columns=by_columns)
                directions = rays_L[fired:due]
                times = (np.arange(fired, due) + 0.5) * (period / rays)
                returned, ranges = self._fire(context, settings, generator, directions, times + (start - now))
                slices = (*slices, np.column_stack((directions[returned], ranges, times[returned])))
                fired = due
            if fired < rays or start + period > now + _ROUNDING:
                break
            returns = ScanInProgress(slices).returns()
            scan = Scan(returns[:, :3], returns[:, 3], np.minimum(returns[:, 4] - period, 0.0), start + period)
            self._scans.take(state, {_SCAN: scan})
            start, slices, fired = start + period, (), 0
            period, rows, columns, by_columns = _next_scan(settings.config)
        state.get_mutable_abstract_state(int(self._progress)).set_value(ScanInProgress(slices))
        present.scan_start, present.scan_period = start, period
        present.scan_rows, present.scan_columns, present.scan_by_columns = rows, columns, by_columns
        present.fired = fired
        return EventStatus.Succeeded()

    def _is_random(self, context: Context, settings: _ScannerSettings) -> bool:
        errors = settings.errors
        random = settings.config.divergence or errors.noise or errors.outlier_probability or errors.dropout
        return bool(random) or self._haze_port.HasValue(context)

    def _fire(
        self,
        context: Context,
        settings: _ScannerSettings,
        generator: np.random.Generator,
        directions: Array,
        times: Array,
    ) -> tuple[NDArray[np.intp], Array]:
        """Return the indices of the rays that are reported, and their ranges (m).

        Args:
            context: The Context at the end of the slice.
            settings: The settings of the scanner.
            generator: The generator of the slice.
            directions: The directions of the rays, as they are reported, shape (n, 3).
            times: Their firing times in s, relative to the end of the slice, shape (n,).
        """
        config, errors = settings.config, settings.errors
        beams = directions
        if config.divergence:
            # The part along the beam vanishes with the length.
            beams = directions + config.divergence / 4.0 * generator.standard_normal(directions.shape)
            beams /= np.sqrt(np.einsum("ij,ij->i", beams, beams))[:, np.newaxis]
        X_WB, V_WB = self._poses_port.Eval(context), self._velocities_port.Eval(context)
        X_WL, V_WL = self._motion(context)
        # Beyond it, not even perpendicular surfaces are detected.
        reach = config.max_range * sqrt(config.reflectivity)
        hits = self._caster.cast(beams, times, X_WL=X_WL, V_WL=V_WL, X_WB=X_WB, V_WB=V_WB, reach=reach)
        power, distances = hits.cosines * reach**2, hits.distances
        if self._haze_port.HasValue(context):
            haze = HAZE.view(self._haze_port.Eval(context))
            power *= two_way_transmission(haze.extinction, np.minimum(distances, reach))
            ranges = np.where(power >= distances**2, distances, inf)
            uniform = generator.random(len(ranges))
            false = false_return_ranges(
                uniform, extinction=haze.extinction, backscatter=haze.backscatter, least_range=config.min_range
            )
            ranges = np.where(false < np.minimum(distances, reach), false, ranges)
        else:
            ranges = np.where(power >= distances**2, distances, inf)
        returned = np.flatnonzero(ranges < inf)
        ranges = _with_errors(ranges[returned], errors, generator)
        reported = (config.min_range <= ranges) & (ranges <= config.max_range)
        return returned[reported], ranges[reported]


def connect_laser_scanner(
    builder: DiagramBuilder, scanner: LaserScanner, plant: MultibodyPlant, *, haze: Haze | None = None
) -> None:
    """Connect a laser scanner with its plant, and with the haze.

    Args:
        builder: The builder of the Diagram with all of them.
        scanner: The scanner.
        plant: The plant that it is mounted on, for its pose and its motion.
        haze: The haze; None for clear air.
    """
    for name in ("body_poses", "body_spatial_velocities"):
        builder.Connect(plant.GetOutputPort(name), scanner.GetInputPort(name))
    if haze is not None:
        builder.Connect(haze.GetOutputPort("haze"), scanner.GetInputPort("haze"))


def raster_size(config: LaserScannerConfig) -> tuple[int, int]:
    """Return the numbers of rows and columns of a scan: as many rows as given, or at about equal angular distances."""
    rays = config.rays_per_second / config.frequency
    rows = int(config.rows) or max(1, round(sqrt(rays * config.elevation / config.azimuth)))
    return rows, max(1, round(rays / rows))


def _next_scan(config: LaserScannerConfig) -> tuple[float, int, int, bool]:
    """Return the period of a scan that begins now (s), its rows and columns, and whether it goes column by column."""
    return 1.0 / config.frequency, *raster_size(config), config.rows > 0


@lru_cache(16)
def raster(rows: int, columns: int, azimuth: float, elevation: float, *, by_columns: bool = False) -> Array:
    """Return the directions of a scan's rays in the order in which they are fired, read-only, shape (rows columns, 3).

    Args:
        rows: Number of rows, which follow each other from the top.
        columns: Number of rays in each row, which follow each other from the right.
        azimuth: Width of the field of view about z, in rad.
        elevation: Height of the field of view, in rad.
        by_columns: Whether all rays of a column are fired before the next column's, instead of row by row.
    """
    up = elevation * (0.5 - (np.arange(rows) + 0.5) / rows)
    left = azimuth * ((np.arange(columns) + 0.5) / columns - 0.5)
    if by_columns:
        up, left = np.tile(up, columns), np.repeat(left, rows)
    else:
        up, left = np.repeat(up, columns), np.tile(left, rows)
    directions = np.stack([np.cos(up) * np.cos(left), np.cos(up) * np.sin(left), np.sin(up)], axis=1)
    directions.flags.writeable = False
    return directions


def _with_errors(ranges: Array, errors: ErrorModel, generator: np.random.Generator) -> Array:
    """Return the ranges (m) with their errors; 0 for those that drop out."""
    if errors.noise:
        ranges = ranges + errors.noise * generator.standard_normal(len(ranges))
    if errors.outlier_probability:
        outliers = generator.random(len(ranges)) < errors.outlier_probability
        ranges = ranges + outliers * errors.outlier_size * generator.standard_normal(len(ranges))
    if errors.bias:
        ranges = ranges + errors.bias
    if errors.quantization:
        ranges = np.round(ranges / errors.quantization) * errors.quantization
    if errors.dropout:
        ranges = np.where(generator.random(len(ranges)) < errors.dropout, 0.0, ranges)
    return ranges
