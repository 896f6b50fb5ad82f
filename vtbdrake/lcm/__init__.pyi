"""The public names of the bridge to LCM."""

from vtbdrake.lcm.arm_messages import iiwa_command as iiwa_command
from vtbdrake.lcm.arm_messages import iiwa_status as iiwa_status
from vtbdrake.lcm.arm_messages import panda_command as panda_command
from vtbdrake.lcm.arm_messages import panda_status as panda_status
from vtbdrake.lcm.arm_messages import wsg_command as wsg_command
from vtbdrake.lcm.arm_messages import wsg_status as wsg_status
from vtbdrake.lcm.bridge import LcmBridge as LcmBridge
from vtbdrake.lcm.drake_messages import image_array_map as image_array_map
from vtbdrake.lcm.drake_messages import image_map as image_map
from vtbdrake.lcm.drake_messages import point_cloud_map as point_cloud_map
from vtbdrake.lcm.drake_messages import scan_map as scan_map
from vtbdrake.lcm.hub import Hub as Hub
from vtbdrake.lcm.hub import HubConfig as HubConfig
from vtbdrake.lcm.maps import LcmMap as LcmMap
from vtbdrake.lcm.maps import VectorMap as VectorMap
from vtbdrake.lcm.maps import vector_map as vector_map
from vtbdrake.lcm.protocol import Protocol as Protocol
from vtbdrake.lcm.protocol import ProtocolError as ProtocolError
