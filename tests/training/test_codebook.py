# SPDX-License-Identifier: Apache-2.0
"""Fitting a codebook: centres by hand, the same for the same seed, kept by files, named by the fingerprint."""

from dataclasses import replace

import pytest
import torch

from manyeyes.datatypes import ConfigError
from manyeyes.models import checkpoint
from manyeyes.models.detector.codebook import FREQUENCY_TOTAL, CodebookConfig
from manyeyes.models.detector.detector import Detector
from manyeyes.models.detector.presets import COSTR_TINY
from manyeyes.models.detector.proposal import PROPOSAL_DIM
from manyeyes.training.detector.codebook import (
    collect_shared_tokens,
    fit_centres,
    fit_codebook,
    fit_frequencies,
    k_means,
    with_codebook,
)

torch.set_num_threads(1)


@pytest.fixture(scope="module")
def detector() -> Detector:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return Detector(COSTR_TINY).eval().requires_grad_(False)


def test_means_of_three_heaps_by_hand():
    heaps = torch.tensor([[0.0, 0.0], [0.0, 2.0], [10.0, 0.0], [10.0, 2.0], [0.0, 50.0]])
    for seed in range(5):
        found = k_means(heaps, 3, (seed,))
        assert sorted(found.tolist()) == [[0.0, 1.0], [0.0, 50.0], [10.0, 1.0]]


def test_fewer_rows_than_centres_are_all_kept():
    rows = torch.tensor([[1.0], [4.0], [9.0]])
    assert set(k_means(rows, 8, ("few",)).flatten().tolist()) == {1.0, 4.0, 9.0}


@pytest.mark.parametrize("seed", range(10))
def test_initial_centres_are_different_rows(seed):
    """A row is drawn in proportion to its squared distance from the centres before it, hence a copy of one never."""
    rows = torch.tensor([[0.0, 0.0], [0.0, 1.0], [50.0, 0.0], [-20.0, 7.0], [3.0, 3.0]])
    found = k_means(rows.repeat(20, 1), 5, (seed,), iterations=0)
    assert sorted(found.tolist()) == sorted(rows.tolist())


def test_the_same_seed_gives_the_same_centres_and_each_stage_helps():
    x = torch.randn(600, 6, generator=torch.Generator().manual_seed(0))
    one, same, other = (fit_centres(x, CodebookConfig(2, 16), seed) for seed in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)
    left = x - one[0][torch.cdist(x, one[0]).argmin(1)]
    after = left - one[1][torch.cdist(left, one[1]).argmin(1)]
    assert x.var() > left.var() > after.var()


def test_frequencies_by_hand():
    """Half 0, a quarter 1, a quarter 255: one for every value, and the other 3,840 by share."""
    codes = torch.tensor([0, 0, 1, 255], dtype=torch.uint8).repeat(100)[:, None]
    table = fit_frequencies(torch.cat((codes, codes * 0 + 9), 1))
    assert table.sum(1).tolist() == [FREQUENCY_TOTAL] * 2 and int(table.min()) == 1
    assert table[0, [0, 1, 255, 2]].tolist() == [1921, 961, 961, 1]
    assert int(table[1, 9]) == FREQUENCY_TOTAL - 255


def test_fitted_detector_shares_equal_tokens_and_has_another_fingerprint(detector, toy, tmp_path):
    recording = toy(agents_n=2, points_per_car=40, ground_points=100)
    reports = []
    fitted = fit_codebook(
        detector, recording, seed=3, config=CodebookConfig(2, 32), frame_stride=2, report=reports.append
    )
    done = [(report.frames, report.tokens) for report in reports]
    assert done == sorted(done) and done[0] == (0, 0) and reports[-1].tokens > 100
    assert {report.total for report in reports} == {reports[-1].frames}
    assert fitted.fingerprint != checkpoint.fingerprint(detector)
    tokens = torch.cat(list(collect_shared_tokens(detector, recording, 2)))
    assert torch.equal(torch.cat(list(collect_shared_tokens(fitted, recording, 2))), tokens)
    features, back = (
        tokens[:, :-PROPOSAL_DIM],
        fitted.codebook.decode(fitted.codebook.encode(tokens))[:, :-PROPOSAL_DIM],
    )
    assert (back - features).square().mean() < 0.8 * features.var(0).mean()
    assert with_codebook(detector, tokens, 3, CodebookConfig(2, 32)).fingerprint == fitted.fingerprint
    # Fitted again, the old book is gone.
    assert with_codebook(fitted, tokens, 3, CodebookConfig(2, 32)).fingerprint == fitted.fingerprint
    for half in (False, True):
        path = tmp_path / f"{half}.safetensors"
        checkpoint.save(fitted, path, {}, half)
        loaded = checkpoint.load(path)
        assert torch.equal(loaded.codebook.centres, fitted.codebook.centres)
        assert torch.equal(loaded.codebook.frequencies, fitted.codebook.frequencies)
        assert loaded.codebook.frequencies.dtype == torch.int16
        assert half or loaded.fingerprint == fitted.fingerprint


def test_fit_without_tokens_is_refused(detector, toy):
    empty = toy(agents_n=1, cars=1, points_per_car=1, ground_points=1, frames=1)
    blind = Detector(detector.config)
    blind.load_state_dict(detector.state_dict())
    blind.eval().requires_grad_(False).token_prune.score.bias.fill_(-100.0)
    with pytest.raises(ConfigError, match="no codebook can be fitted"):
        fit_codebook(blind, empty)


def test_fit_of_a_fusion_without_proposals_is_refused_before_any_frame(detector, toy):
    bare = Detector(replace(detector.config, fusion="max/bare"))
    with pytest.raises(ConfigError, match="max/bare sends features without proposals: it has no codebook; use float16"):
        fit_codebook(bare, toy(), report=lambda progress: pytest.fail("a frame was begun"))
