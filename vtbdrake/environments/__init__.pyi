"""Environments for reinforcement learning."""

from .compiled_vector import CompiledVectorEnv as CompiledVectorEnv
from .env import TestbedEnv as TestbedEnv
from .episodes import Episodes as Episodes
from .episodes import FailedEpisodeError as FailedEpisodeError
from .make import gymnasium_env as gymnasium_env
from .make import gymnasium_vector_env as gymnasium_vector_env
from .process_vector import ProcessVectorEnv as ProcessVectorEnv
from .rewards import Reward as Reward
from .spaces import ActionError as ActionError
from .vector import TestbedVectorEnv as TestbedVectorEnv
