"""The public names about residuals and live values."""

from vtbdrake.monitoring.domain_monitor import DomainMonitor as DomainMonitor
from vtbdrake.monitoring.live.client import LiveClient as LiveClient
from vtbdrake.monitoring.live.client import LiveError as LiveError
from vtbdrake.monitoring.live.client import LiveTimeoutError as LiveTimeoutError
from vtbdrake.monitoring.live.client import LiveWatch as LiveWatch
from vtbdrake.monitoring.live.client import watch as watch
from vtbdrake.monitoring.live.service import LiveService as LiveService
from vtbdrake.monitoring.residuals import Alarm as Alarm
from vtbdrake.monitoring.residuals import NominalResiduals as NominalResiduals
from vtbdrake.monitoring.residuals import ResidualConfig as ResidualConfig
from vtbdrake.monitoring.residuals import ResidualMonitor as ResidualMonitor
