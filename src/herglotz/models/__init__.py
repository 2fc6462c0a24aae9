"""Learnable discrete contact Lagrangians."""

from herglotz.models.model import LEVELS, ContactLagrangian, ModelConfig

__all__ = ["LEVELS", "ContactLagrangian", "ModelConfig"]
