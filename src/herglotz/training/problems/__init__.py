"""Objectives as sums of squares: one step, whole trajectories, smoothing."""
