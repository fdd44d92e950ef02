# SPDX-License-Identifier: Apache-2.0
"""ERMVP's compression: density peaks by hand and by a loop, weighted means, and gradients."""

import torch
from tests.models.fusion_cases import CHANNELS, CONFIG, draw_agent, tokens_of
from torch.nn import functional

from manyeyes.models.detector.cluster_rows import decode_cluster_rows, encode_cluster_rows
from manyeyes.models.detector.proposal_codes import proposal_from_codes, proposal_to_codes
from manyeyes.models.fusion import clusters
from manyeyes.models.fusion.clusters import ClusterCompression, cluster_by_density_peaks
from manyeyes.models.fusion.registry import get_fusion


def drawn(n: int = 60, seed: int = 0) -> torch.Tensor:
    return torch.randn(n, CHANNELS, generator=torch.Generator().manual_seed(seed))


def test_two_blobs_are_two_clusters() -> None:
    rows = torch.cat((0.1 * drawn(20), 0.1 * drawn(30, 1) + 5))
    cluster = cluster_by_density_peaks(rows, 2)
    assert len(cluster[:20].unique()) == len(cluster[20:].unique()) == 1 and cluster[0] != cluster[20]


def test_clusters_are_those_of_loops() -> None:
    rows, count = drawn(), 7
    n = len(rows)
    d = [[float((a - b).norm()) / CHANNELS**0.5 for b in rows] for a in rows]
    spread = [sum(v * v for v in sorted(line)[1:11]) / 10 for line in d]
    delta = [min((d[i][j] for j in range(n) if spread[j] < spread[i]), default=max(map(max, d))) for i in range(n)]
    peak = [float(torch.exp(torch.tensor(-s))) * x for s, x in zip(spread, delta)]
    centres = sorted(range(n), key=lambda i: -peak[i])[:count]
    expected = [min(range(count), key=lambda k, i=i: d[i][centres[k]]) for i in range(n)]
    assert cluster_by_density_peaks(rows, count).tolist() == expected


def test_as_many_clusters_as_rows_compress_nothing(monkeypatch) -> None:
    monkeypatch.setattr(clusters, "CLUSTER_FRACTION", 1.0)
    torch.manual_seed(0)
    model, rows = ClusterCompression(CHANNELS), drawn()
    out = model(rows)
    score = torch.sigmoid(model.scoring(rows))
    assert torch.allclose(out.features, functional.layer_norm(rows, (CHANNELS,)) * score, atol=1e-6)


def test_a_cluster_is_its_mean_weighted_by_score_and_trains_it() -> None:
    torch.manual_seed(0)
    model, rows = ClusterCompression(CHANNELS), drawn().requires_grad_(True)
    out = model(rows)
    assert len(out.cluster.unique()) == round(0.2 * len(rows))
    normed = functional.layer_norm(rows, (CHANNELS,)) * out.score[:, None]
    for number in out.cluster.unique():
        mine = out.cluster == number
        mean = (normed[mine] * out.score[mine, None]).sum(0) / out.score[mine].sum()
        assert torch.allclose(out.features[mine], mean.expand(int(mine.sum()), -1), atol=1e-5)
    (out.features * drawn(seed=3)).sum().backward()
    assert bool(rows.grad.abs().sum(1).gt(0).all()) and bool(model.scoring.weight.grad.any())


def test_few_rows_are_compressed_too() -> None:
    model = ClusterCompression(CHANNELS)
    for n in (0, 1, 2, 5):
        assert model(drawn(n)).features.shape == (n, CHANNELS)
    assert bool(torch.isfinite(model(torch.zeros(30, CHANNELS)).features).all())


def test_rows_of_bytes_keep_float16_and_the_codes_of_proposals() -> None:
    rows = tokens_of(draw_agent(0, False))
    whole = torch.cat((rows.features, rows.proposal), 1)
    for tokens, is_bare in ((whole, False), (rows.features, True)):
        back = decode_cluster_rows(encode_cluster_rows(tokens, is_bare), is_bare)
        assert torch.equal(back[:, :CHANNELS], rows.features.half().float())
        assert is_bare or torch.equal(back[:, CHANNELS:], proposal_from_codes(proposal_to_codes(rows.proposal)))


def test_both_modes_of_ermvp_send_clusters() -> None:
    for name in ("ermvp", "ermvp/bare"):
        assert isinstance(get_fusion(name)(CHANNELS, CONFIG).compression, ClusterCompression)
