"""Named terms of many coordinates: offers between those that a force couples, at the noise of whole trajectories."""

from dataclasses import replace
from functools import cache
from typing import Any

import torch

from herglotz.data import simulate
from herglotz.scenes import scene
from herglotz.training import FitConfig, fit, structure
from herglotz.training.baseline import estimate_baseline
from herglotz.training.coupled_pairs import coupled_pairs, terms_between
from herglotz.training.structure import many_are_free, search_of_many


@cache
def chain(masses, noise=0.003, seed=0, trajectories=10, steps=40):
    of = scene("chain", masses=masses)
    return simulate(of, trajectories=trajectories, steps=steps, h=0.1, noise=noise, seed=seed)


def test_neighbours_of_a_chain_are_coupled_and_no_others():
    # fails if a spring is missed, or if noise couples others: without the price of a choice 11 pairs in ten draws
    neighbours, false = {(i, i + 1) for i in range(19)}, 0
    for seed in range(10):
        found = coupled_pairs(chain(20, seed=seed))
        assert found is not None
        assert neighbours <= set(found)
        false += len(found) - len(neighbours)
    # 0 in 15 draws
    assert false <= 2


def test_bodies_without_springs_between_them_have_no_pairs():
    # fails if positions of other bodies are taken for forces: each of these chains of one mass moves alone
    alone = [chain(1, seed=k) for k in range(5)]
    data = replace(alone[0], q=torch.cat([one.q for one in alone], 1), names=tuple("abcde"), units=("m",) * 5,
                   angles=(False,) * 5)  # fmt: skip
    assert coupled_pairs(data) == []


def test_few_samples_couple_nothing():
    # fails if a regression with as many coefficients as independent samples is believed
    assert coupled_pairs(chain(10, trajectories=2)) is None


def test_terms_between_pairs():
    # fails if a pair that nothing couples has a term, or one of a coupled pair or of a single coordinate is lost
    names = terms_between([(0, 1), (2, 3)], (False,) * 4)
    assert set(names) == {
        *(f"(q{i} - q{j})^{k}" for i, j in ((1, 2), (3, 4)) for k in (2, 3, 4)),
        *(f"q{i}^{k}" for i in range(1, 5) for k in (3, 4)),
    }


def test_more_coordinates_than_a_search_takes_are_free_where_they_have_noise():
    # fails if exact data, which one-step errors fit better, three coordinates, angles or a user's terms come here
    assert many_are_free(chain(4), FitConfig())
    assert not many_are_free(chain(3), FitConfig())
    assert not many_are_free(chain(4, noise=0.0), FitConfig())
    assert not many_are_free(replace(chain(4), angles=(True, *(False,) * 3), units=("rad", *("m",) * 3)), FitConfig())
    named: list[dict[str, Any]] = [{"features": ("chain",)}, {"objective": "residual"}, {"level": "linear"}]
    for told in named:
        assert not many_are_free(chain(4), FitConfig(**told))


def test_a_noisy_chain_is_found():
    # fails if terms of a pair are lost, or networks take their place: they missed unseen motion of twenty masses by a
    # quarter of its size
    run = fit(chain(4), FitConfig(train_fraction=1.0), progress=False)
    plan, springs = run.metrics["plan"], {f"(q{i} - q{i + 1})^{k}" for i in range(1, 4) for k in (2, 4)}
    assert (plan["network"], plan["objective"]) == ("none", "trajectory")
    assert springs | {"q1^4", "q4^4"} == set(plan["features"])
    assert run.metrics["verdict"].startswith("fits to the noise")


def test_terms_that_miss_by_more_than_the_noise_are_no_result():
    # fails if terms stand in for a force that they lack: a magnet on the third body, which networks may have
    data = chain(4)
    pushed = data.q + 0.05 * torch.sin(4 * data.t)[:, None] * torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=data.q.dtype)
    data = replace(data, q=pushed)
    config = FitConfig().resolved(data)
    found = search_of_many(data, estimate_baseline(data), config, outliers=False)
    assert found.sigma is None
    assert found.config is config
    assert "miss the data by more than the noise" in found.reason


def test_more_numbers_than_a_kernel_takes_are_no_result(monkeypatch):
    # fails if a search without a kernel begins, whose fits take minutes
    monkeypatch.setattr(structure, "MAX_PARAMETERS", 30)
    data = chain(4)
    found = search_of_many(data, estimate_baseline(data), FitConfig().resolved(data), outliers=False)
    assert found.sigma is None
    assert "too many forces" in found.reason
