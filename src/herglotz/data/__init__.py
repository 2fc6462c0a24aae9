"""Trajectories: read, written, split, simulated."""

from herglotz.data.anything import as_trajectories as as_trajectories
from herglotz.data.checks import MIN_SAMPLES as MIN_SAMPLES
from herglotz.data.csv_format import read_csv as read_csv, write_csv as write_csv
from herglotz.data.npz_format import read_npz as read_npz, write_npz as write_npz
from herglotz.data.readers import load as load, save as save
from herglotz.data.schmidt_lipson import read_schmidt_lipson as read_schmidt_lipson
from herglotz.data.simulate import simulate as simulate
from herglotz.data.trajectories import Trajectories as Trajectories
