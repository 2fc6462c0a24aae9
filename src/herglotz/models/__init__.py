"""Learnable discrete contact Lagrangians."""

from herglotz.models.capabilities import Capabilities, capabilities
from herglotz.models.config import LEVELS, ModelConfig
from herglotz.models.model import ContactLagrangian, DrivenLagrangian

__all__ = ["LEVELS", "Capabilities", "ContactLagrangian", "DrivenLagrangian", "ModelConfig", "capabilities"]
