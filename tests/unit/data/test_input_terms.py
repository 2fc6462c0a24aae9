"""Inputs that act by their square, their size or their rate: columns of u that follow from recorded ones."""

import math
from dataclasses import replace

import pytest
import torch

from herglotz.data import Trajectories, as_trajectories, load
from herglotz.data.input_terms import all_input_terms, input_terms_of, saturation, with_input_terms
from herglotz.data.readers import save
from herglotz.errors import InputError

T = torch.linspace(0, 2, 41, dtype=torch.float64)
TABLE = "t[s],x[m],volts[V],base[m]\n"


def recording(tmp_path, name="train.csv", phase=0.0):
    rows = [f"{t},{math.cos(t)},{math.sin(3 * t + phase)},{0.1 * t * t}" for t in T.tolist()]
    path = tmp_path / name
    path.write_text(TABLE + "\n".join(rows) + "\n")
    return path


def test_terms_are_columns_of_u(tmp_path):
    # fails if a column is of another input, or a rate is that of the step alone
    data = load(
        recording(tmp_path), inputs=["volts", "base"], show=False,
        input_terms=["volts^2", "|volts|", "base'", "|volts| volts"],
    )  # fmt: skip
    assert data.u is not None
    assert data.input_labels == (
        ("volts", "V"), ("base", "m"), ("volts^2", "V^2"), ("|volts|", "V"), ("base'", "m/s"), ("|volts| volts", "V^2"),
    )  # fmt: skip
    volts = torch.sin(3 * T)
    assert torch.allclose(data.u[:, 2], volts**2)
    assert torch.allclose(data.u[:, 3], volts.abs())
    assert torch.allclose(data.u[1:-1, 4], 0.2 * T[1:-1], atol=1e-12)
    assert torch.allclose(data.u[:, 5], volts.abs() * volts)
    assert "input term" in data.table()


def test_rates_do_not_cross_from_one_recording_to_the_next():
    # fails if the last value of a recording is the neighbour of the first of the next one
    u = torch.cat([T, 5 - T])[:, None]
    both = Trajectories.of(torch.cat([T, T]), torch.cat([T, T]).sin(), [41, 41], u=u)
    found = with_input_terms(both, ["u'"])
    assert found.u is not None
    assert torch.allclose(found.u[:, 1], torch.cat([torch.ones_like(T), -torch.ones_like(T)]))


def test_a_later_recording_has_the_same_terms(tmp_path):
    # fails if a model is driven by columns that another file does not get
    first = load(recording(tmp_path), inputs=["volts"], input_terms="volts^2", show=False)
    other = load(recording(tmp_path, "new.csv", 0.4), like=first, show=False)
    assert input_terms_of(other.columns) == ("volts^2",)
    assert other.u is not None
    assert torch.allclose(other.u[:, 1], other.u[:, 0] ** 2)
    assert load(recording(tmp_path), like=first, input_terms=(), show=False).u.shape[1] == 1  # pyright: ignore


@pytest.mark.parametrize(("unit", "squared"), [("V", "V^2"), ("-", "-"), ("1", "1"), ("", "")])
def test_the_square_of_a_plain_number_has_no_unit(unit, squared):  # fails if it is "-^2"
    plain = Trajectories.of(T, torch.cos(T), u=torch.sin(T))
    named = replace(plain, columns=(("t", "time", "s"), ("q", "coordinate", "m"), ("u", "input", unit)))
    assert dict(with_input_terms(named, ["u^2"]).input_labels) == {"u": unit, "u^2": squared}


def test_arrays_have_terms_too(tmp_path):
    # fails if terms need the names of a table, one is not offered, a table that was written brings them twice, or an
    # input of one sign has terms that are another one, or itself
    q = torch.cos(T).numpy()
    for u, more in ((torch.sin(T) - 0.5, ["|u|", "|u| u"]), (torch.sin(T), []), (-torch.sin(T), [])):
        plain = as_trajectories(q, time=T.numpy(), inputs=u.numpy())
        assert sorted(all_input_terms(plain)) == ["u'", "u^2", *more]
    data = as_trajectories(q, time=T.numpy(), inputs=torch.sin(T).numpy(), input_terms=["u^2"])
    assert data.input_labels == (("u", ""), ("u^2", ""))
    assert all_input_terms(data) == ()
    assert with_input_terms(data, ["u^2"]) is data
    save(tmp_path / "own.npz", data)
    again = load(tmp_path / "own.npz", show=False)
    assert torch.equal(again.u, data.u)  # pyright: ignore


def test_inputs_saturate_at_a_level():
    # fails if a level is taken for another number, or a saturation is not the same in another recording
    data = Trajectories.of(T, T.cos(), u=2 * T.sin())
    found = with_input_terms(data, ["sat(u/0.5)", "tanh(u/2e-1)"])
    assert found.u is not None
    assert torch.allclose(found.u[:, 1], (4 * T.sin()).clamp(-1, 1))
    assert torch.allclose(found.u[:, 2], torch.tanh(10 * T.sin()))
    assert found.input_labels == (("u", ""), ("sat(u/0.5)", ""), ("tanh(u/2e-1)", ""))
    assert saturation("sat(a/b/0.5)") == ("sat", 0.5, "a/b")


@pytest.mark.parametrize("term", ["volts^3", "speed'", "volts", "sat(volts)", "sat(volts/0)", "tanh(speed/2)"])
def test_a_term_of_no_input_is_refused(tmp_path, term):
    # fails if a word that is misspelt drops a term silently
    forms = r"x\^2, \|x\| x, \|x\|, x', sat\(x/2\) or tanh\(x/2\) of an input x, 2 being its level"
    with pytest.raises(InputError, match=rf"is no term of an input; write {forms} > 0; the inputs are"):
        load(recording(tmp_path), inputs=["volts", "base"], input_terms=[term], show=False)


def test_a_term_of_an_input_needs_an_input():  # fails if the message lists "no inputs" as the inputs
    data = Trajectories.of(range(4), range(4))
    with pytest.raises(InputError, match=r"the data have no input: name one with --inputs NAMES"):
        with_input_terms(data, ["V^2"])
