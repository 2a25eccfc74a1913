import pytest

from torchkcreg.geometry import MultisourceScanner
from torchkcreg.reconstruction import ordered_subsets


def test_each_view_is_in_one_subset():
    subsets = ordered_subsets(200, 20)
    assert sorted(view for subset in subsets for view in subset) == list(range(200))
    assert {len(subset) for subset in subsets} == {10}


def test_each_subset_of_the_scanner_has_all_focal_spots():
    sources = MultisourceScanner().view_sources()
    for subset in ordered_subsets(200, 20, sources=sources):
        counts = {source: [sources[view] for view in subset].count(source) for source in ["T1", "T2", "T3"]}
        assert counts["T2"] == 5 and counts["T1"] in (2, 3) and counts["T3"] in (2, 3)


def test_wrong_counts_are_named():
    with pytest.raises(ValueError, match="between 1 and the number of views 5"):
        ordered_subsets(5, 6)
    with pytest.raises(ValueError, match="one entry for each"):
        ordered_subsets(5, 2, sources=["a"])
