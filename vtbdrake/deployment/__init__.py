"""How a DPS runs on its machine: the loop, with its bridge, guards, recorder and monitors."""

from vtbdrake.deployment.deployment import Deployment, DeploymentError, deploy

__all__ = ["Deployment", "DeploymentError", "deploy"]
