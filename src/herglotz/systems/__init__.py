"""Scenes with known answers, the rules that discretise them, and the reference flow they are measured against."""

from herglotz.systems.oscillator import ExactOscillator, damped_oscillator
from herglotz.systems.parachute import ExactParachute, parachute
from herglotz.systems.pendulum import damped_pendulum
from herglotz.systems.reference import ReferenceSolution, reference_flow, reference_solve
from herglotz.systems.registry import scene, scene_names
from herglotz.systems.rules import left, midpoint, midpoint_heun, trapezoid_heun
from herglotz.systems.scene import Scene

__all__ = [
    "ExactOscillator",
    "ExactParachute",
    "ReferenceSolution",
    "Scene",
    "damped_oscillator",
    "damped_pendulum",
    "left",
    "midpoint",
    "midpoint_heun",
    "parachute",
    "reference_flow",
    "reference_solve",
    "scene",
    "scene_names",
    "trapezoid_heun",
]
