"""The public names of the bridge to LCM."""

from .command_messages import command_map as command_map
from .command_messages import command_message as command_message
from .hub import Hub as Hub
from .hub import HubConfig as HubConfig
from .iiwa_messages import iiwa_command as iiwa_command
from .iiwa_messages import iiwa_status as iiwa_status
from .lcm_bridge import LcmBridge as LcmBridge
from .maps import LcmMap as LcmMap
from .maps import VectorMap as VectorMap
from .maps import vector_map as vector_map
from .panda_messages import PANDA_MODE as PANDA_MODE
from .panda_messages import panda_command as panda_command
from .panda_messages import panda_status as panda_status
from .protocol import Protocol as Protocol
from .protocol import ProtocolError as ProtocolError
from .sensor_messages import image_array_map as image_array_map
from .sensor_messages import image_map as image_map
from .sensor_messages import point_cloud_map as point_cloud_map
from .sensor_messages import scan_map as scan_map
from .wsg_messages import wsg_command as wsg_command
from .wsg_messages import wsg_status as wsg_status
