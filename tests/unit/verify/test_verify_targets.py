"""What `verify` takes, what it refuses, and what its report looks like."""

import json

import pytest
import torch

from herglotz.errors import InputError
from herglotz.export import export_pt2, load_pt2
from herglotz.models import ContactLagrangian, ModelConfig
from herglotz.scenes import scene
from herglotz.stepping import State, Stepper
from herglotz.verify import Check, Report, verify

BOX = {"q_low": [-1.0], "q_high": [1.0], "p_low": [-1.0], "p_high": [1.0], "s_low": [-0.5], "s_high": [0.5]}


def pair(count=8):
    x = torch.randn(count, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return scene("damped_oscillator").L_d, State(x[:, :1], x[:, 1:2], x[:, 2])


def test_a_scene_by_name_and_by_value_are_the_same():
    # fails if the draw does not follow from the seed
    one, two = verify("parachute", samples=8, steps=3), verify(scene("parachute"), samples=8, steps=3)
    assert one.to_dict() == two.to_dict()
    assert one.to_dict() != verify("parachute", samples=8, steps=3, seed=1).to_dict()


def test_an_exact_scene_is_also_held_to_its_flow():
    # fails if a scene's L_d may generate another flow than the closed form
    assert verify("damped_oscillator", samples=4, steps=2)["exact_flow"].passed
    with pytest.raises(KeyError, match="no check 'exact_flow'"):
        verify("damped_pendulum", samples=4, steps=2)["exact_flow"]


def test_an_exported_file(tmp_path):
    # fails if a file, which has no L_d, cannot be judged by its map alone, or is not said to be
    model = ContactLagrangian(ModelConfig(potential_width=0))
    path = export_pt2(model, tmp_path / "model.pt2", h=0.2, box=BOX)
    report = verify(path, samples=8, steps=4)
    assert report.passed, report.table()
    assert report.details["h"] == 0.2
    assert "no L_d in the file: H⁺ rebuilt" in report["hamilton_jacobi"].note
    # What is rebuilt from the map agrees with L_d itself.
    exported = load_pt2(path)
    assert verify(exported, samples=8, steps=4).checks == report.checks
    states = State(*(torch.full((3, *x), 0.3, dtype=torch.float64) for x in ((1,), (1,), ())))
    by_map = verify((_MapOnly(exported), states), h=0.2, steps=3)
    by_L_d = verify((model, states), h=0.2, steps=3)
    assert by_map["regularity"].value == pytest.approx(by_L_d["regularity"].value, rel=0.5)


def test_a_forced_file(tmp_path):
    # fails if friction, which makes a step no contact map, fails the file, or an identity is dropped in silence
    one = (1.0,)
    config = ModelConfig((True,), "forced", one, one, one, (0.0,), rate=0.3, inputs=1, input_zero=True,
                         potential_width=0)  # fmt: skip
    model = ContactLagrangian(config)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.1
    file = load_pt2(export_pt2(model, tmp_path / "model.pt2", h=0.2, box=BOX))
    alone = verify(file, samples=8, steps=4)
    assert all(check.passed for check in alone.checks), alone.table()
    assert alone.missing == ("contact", "momentum")
    assert not alone.passed
    assert "the other checks need the model's forces" in alone["regularity"].note
    report = verify(file, samples=8, steps=4, model=model)
    assert report.passed, report.table()
    assert report["contact"].statement.startswith("forced contact map")
    assert model.friction is not None
    with torch.no_grad():
        model.friction.viscous.copy_(2 * model.friction.viscous)
    assert not verify(file, samples=8, steps=4, model=model)["contact"].passed


class _MapOnly:
    def __init__(self, exported):
        self.step = exported.step


def test_a_wrong_file_fails():
    # fails if the checks on a map alone accept a map that is not contact
    L_d, states = pair()

    class Wrong:
        def step(self, state, h):
            step = Stepper(L_d).step(state, h)
            return type(step)(step.state._replace(p=1.1 * step.state.p), step.c, step.status, step.residual, 1)

    report = verify((Wrong(), states), h=0.1, steps=3)
    failed = {check.name for check in report.checks if not check.passed}
    assert {"contact", "volume", "momentum", "D2S", "hamilton_jacobi"} <= failed


def test_a_tolerance_replaces_the_bounds():
    # fails if the tolerance is ignored: nothing is exact to 1e-300
    report = verify(pair(), h=0.1, steps=3, tolerance=1e-300)
    assert not report["contact"].passed
    assert report["contact"].bound == report["D2S"].bound == 1e-300


@pytest.mark.parametrize(
    ("target", "options", "message"),
    [
        ("pendulumm", {}, "no such scene .*damped_pendulum.* run folder or .pt2"),
        (3.0, {}, "cannot verify a float"),
        (pair(), {}, "h must be given with a pair"),
        (pair(), {"h": -1.0}, "h must be finite and > 0, got -1"),
        ("parachute", {"h": 0.0}, "h must be finite and > 0"),
        ("parachute", {"steps": 1}, "steps must be >= 2"),
        ("parachute", {"samples": 0}, "samples must be >= 1"),
        ("parachute", {"tolerance": 0.0}, "tolerance must be > 0"),
        ("missing.pt2", {}, "no such file"),
        ((pair()[0], (torch.ones(3), torch.ones(3), torch.ones(3))), {"h": 0.1}, "states need shapes"),
    ],
)
def test_what_is_refused(target, options, message):
    # fails if a user's mistake ends in a traceback from torch
    with pytest.raises(InputError, match=message):
        verify(target, **options)


def test_the_table_lines_up_and_says_what_failed():
    # fails if a column moves with the length of a claim, a failure looks like a success, or a note is lost
    report = Report(
        "toy",
        (
            Check.at_most("a", "short", 1e-15, 1e-10),
            Check.at_most("b", "a longer claim Φ̃", 0.5, 1e-10, "because"),
            Check.at_most("c", "nothing measured", float("nan"), 1e-10, "because"),
            Check.more_than("d", "positive", 0.9, 0.0),
        ),
    )
    lines = report.table().replace("\u0303", "").splitlines()
    assert lines[0] == "toy: NOT verified"
    assert [line.split()[-1] for line in lines[2:6]] == ["ok", "FAIL", "FAIL", "ok"]
    assert len({line.index("≤") for line in lines[2:5]} | {lines[5].index(">")}) == 1
    assert lines[3].count("[1]") == lines[4].count("[1]") == 1
    assert lines[6:] == ["  [1] because"]


def test_a_report_is_json():
    # fails if a NaN gets into the JSON, which no strict reader takes
    report = Report("toy", (Check.at_most("a", "nothing", float("nan"), 1.0),), {"h": 0.1})
    plain = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert plain["passed"] is False
    assert plain["checks"][0]["value"] is None
    json.dumps(verify("parachute", samples=4, steps=2).to_dict(), allow_nan=False)


def test_an_empty_report_does_not_pass():
    # fails if no check at all counts as success
    assert not Report("nothing", ()).passed
