"""Trajectories: read, written, split, simulated."""

from herglotz.data.anything import as_trajectories
from herglotz.data.checks import MIN_SAMPLES
from herglotz.data.csv_format import read_csv, write_csv
from herglotz.data.ibm_double_pendulum import read_ibm_double_pendulum
from herglotz.data.npz_format import read_npz, write_npz
from herglotz.data.readers import load, save
from herglotz.data.schmidt_lipson import read_schmidt_lipson
from herglotz.data.simulate import simulate
from herglotz.data.trajectories import Trajectories
from herglotz.data.windows import Steps, Triples

__all__ = [
    "MIN_SAMPLES",
    "Steps",
    "Trajectories",
    "Triples",
    "as_trajectories",
    "load",
    "read_csv",
    "read_ibm_double_pendulum",
    "read_npz",
    "read_schmidt_lipson",
    "save",
    "simulate",
    "write_csv",
    "write_npz",
]
