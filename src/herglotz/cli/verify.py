"""`herglotz verify`: the identities of the theory, measured."""

from __future__ import annotations

import argparse

from herglotz.cli.common import count, positive, print_json
from herglotz.errors import InputError

DESCRIPTION = """\
Measure every identity that a discrete contact Lagrangian must satisfy on a scene, a run or an exported file, and
compare each with its tolerance. The exit code is 0 when all pass and 1 when one fails.

examples:
  herglotz verify damped_oscillator
  herglotz verify runs/pendulum --json
"""


def add(commands: argparse._SubParsersAction) -> None:
    """Add the subcommand."""
    parser = commands.add_parser("verify", help="check the identities of the theory", description=DESCRIPTION)
    parser.add_argument("target", metavar="SCENE|RUN|FILE.pt2", help="name of a scene, folder of a run, or a file")
    parser.add_argument("--h", type=positive, help="step (default: the scene's or the model's own)")
    parser.add_argument("--samples", type=count, default=64, help="states to check at (default %(default)s)")
    parser.add_argument(
        "--steps", type=count, default=8, help="steps of the checks along motions (default %(default)s)"
    )
    parser.add_argument("--seed", type=count, default=0, help="of the states (default %(default)s)")
    parser.add_argument("--json", action="store_true", help="print the report as JSON, and nothing else")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Verify and report; 1 when a check fails."""
    if arguments.samples < 1 or arguments.steps < 2:
        raise InputError(f"--samples must be >= 1 and --steps >= 2, got {arguments.samples} and {arguments.steps}")

    from herglotz.verify import verify

    report = verify(
        arguments.target, h=arguments.h, samples=arguments.samples, steps=arguments.steps, seed=arguments.seed
    )
    if arguments.json:
        print_json(report.to_dict())
    else:
        print(report.table())
    return 0 if report.passed else 1
