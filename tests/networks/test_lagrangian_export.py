"""What becomes of a Lagrangian network when torch writes it down."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed")

from tests.support.lagrangian_reference import SETTINGS, motion, network  # noqa: E402


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["ours", "literal"])
def test_an_exported_network_takes_any_number_of_rows(name) -> None:
    net = network(SETTINGS[name])
    rows = torch.export.Dim("rows", min=1)
    exported = torch.export.export(net, tuple(motion(5)), dynamic_shapes=({0: rows},) * 3)
    other = motion(9, seed=1)
    torch.testing.assert_close(exported.module()(*other), net(*other), rtol=1e-12, atol=0.0)


def test_the_exported_graph_neither_indexes_nor_branches() -> None:
    """What scatters, gathers or selects is what small targets lack."""
    graph = torch.export.export(network(SETTINGS["ours"]), tuple(motion(5))).graph
    used = {str(node.target) for node in graph.nodes if node.op == "call_function"}
    assert not [name for name in used if any(w in name for w in ("index", "gather", "scatter"))]
    assert not [name for name in used if any(w in name for w in ("where", "grad", "cond"))]
