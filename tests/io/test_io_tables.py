import numpy as np
import pytest
import torch

from torchkcreg.io import read_points, read_spectrum, write_points, write_spectrum
from torchkcreg.physics import Spectrum


def test_points_come_back_to_a_millionth_of_a_millimetre(tmp_path):
    points = 300 * torch.randn(40, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    write_points(tmp_path / "p.csv", points)
    assert (tmp_path / "p.csv").read_text().startswith("x,y,z\n")
    torch.testing.assert_close(read_points(tmp_path / "p.csv"), points, rtol=0, atol=6e-7)


def test_further_columns_are_written_and_ignored_when_read(tmp_path):
    points = torch.eye(3)
    write_points(tmp_path / "p.csv", points, outside=torch.tensor([True, False, True]), e=torch.ones(3))
    assert (tmp_path / "p.csv").read_text().splitlines()[:2] == [
        "x,y,z,outside,e",
        "1.000000,0.000000,0.000000,1,1.000000",
    ]
    assert torch.equal(read_points(tmp_path / "p.csv"), points.double())


@pytest.mark.parametrize(
    "text",
    [
        "x,y,z\n1,2,3\n4,5,6\n",
        "1,2,3\n4,5,6",
        "# made by hand\n1; 2; 3\n\n4;5;6  # the last one\n",
        "\ufeffx y z\r\n1 2 3\r\n4\t5 6\r\n",
        "x (mm),y (mm),z (mm)\n 1e0, 2.0, 3\n4,5,6,7\n",
    ],
)
def test_the_usual_ways_to_write_a_table_are_understood(tmp_path, text):
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    assert read_points(tmp_path / "p.csv").tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\n4,5\n", r"line 3: expected numbers x, y, z, got '4,5'"),
        ("x,y,z\nx,y,z\n1,2,3", "line 2"),
        ("1,2,3\n1,nan,3", "line 2"),
        ("1,two,3", "line 1"),
        ("x,y,z\n", "holds no rows"),
        ("", "holds no rows"),
    ],
)
def test_a_bad_line_is_named(tmp_path, text, message):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"points file .*p\.csv.*{message}"):
        read_points(tmp_path / "p.csv")


def test_points_that_are_no_points_are_not_written(tmp_path):
    with pytest.raises(ValueError, match=r"points must have shape \(N, 3\)"):
        write_points(tmp_path / "p.csv", torch.zeros(3))
    with pytest.raises(ValueError, match="row 1 is not"):
        write_points(tmp_path / "p.csv", torch.tensor([[0.0, 0, 0], [0, float("nan"), 0]]))
    with pytest.raises(ValueError, match="column outside"):
        write_points(tmp_path / "p.csv", torch.zeros(2, 3), outside=torch.zeros(3))
    assert list(tmp_path.iterdir()) == []


def test_a_spectrum_comes_back(tmp_path):
    spectrum = Spectrum((20.0, 40.0, 81.5), (0.25, 0.5, 0.25))
    write_spectrum(tmp_path / "s.csv", spectrum)
    again = read_spectrum(tmp_path / "s.csv")
    assert again.energies_kev == pytest.approx(spectrum.energies_kev)
    assert again.weights == pytest.approx(spectrum.weights)


def test_the_scale_of_a_spectrum_does_not_matter(tmp_path):
    (tmp_path / "s.csv").write_text("energy,weight\n30,2\n60,6\n")
    assert np.asarray(read_spectrum(tmp_path / "s.csv").weights) == pytest.approx([0.25, 0.75])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("30,1\n20,1\n", "rise"),
        ("30000,1\n60000,1\n", "keV"),
        ("-1,1\n20,1\n", "keV"),
        ("20,1\n30,-1\n", "weights"),
        ("20,0\n30,0\n", "weights"),
        ("20\n30\n", "line 1"),
    ],
)
def test_a_bad_spectrum_is_refused_by_name(tmp_path, text, message):
    (tmp_path / "s.csv").write_text(text)
    with pytest.raises(ValueError, match=rf"spectrum file .*s\.csv.*{message}"):
        read_spectrum(tmp_path / "s.csv")
