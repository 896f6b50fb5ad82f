"""The public names about residuals and live values."""

from .domain_monitor import DomainMonitor as DomainMonitor
from .live.client import LiveClient as LiveClient
from .live.client import LiveError as LiveError
from .live.client import LiveTimeoutError as LiveTimeoutError
from .live.client import LiveWatch as LiveWatch
from .live.client import watch as watch
from .live.service import LiveService as LiveService
from .residuals import Alarm as Alarm
from .residuals import NominalResiduals as NominalResiduals
from .residuals import ResidualConfig as ResidualConfig
from .residuals import ResidualMonitor as ResidualMonitor
