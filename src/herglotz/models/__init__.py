"""Learnable discrete contact Lagrangians."""

from herglotz.models.config import LEVELS, ModelConfig
from herglotz.models.model import ContactLagrangian, DrivenLagrangian

__all__ = ["LEVELS", "ContactLagrangian", "DrivenLagrangian", "ModelConfig"]
