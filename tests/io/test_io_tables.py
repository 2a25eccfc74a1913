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
        "x (mm),y (mm),z (mm)\n 1e0, 2.0, 3\n4,5,6\n",
        "x;y;z\n1,0;2,0;3,0\n4;5,0;6\n",
        '"x","y","z"\n"1,0","2,0","3,0"\n"4,0","5","6,0"\n',
        "x\ty\tz\n1,0\t2,0\t3,0\n4,0\t5,0\t6,0\n",
        "1,0 2,0 3,0\n4,0 5,0 6,0\n",
        "id,x,y,z\n7,1,2,3\n8,4,5,6\n",
        "label;Z [mm];Y [mm];X [mm];remark\nA;3,0;2;1;\nB;6;5;4;none\n",
        "1,2,3,\n4,5,6,\n",
        "-0,x,y,z\n".replace("-0", "e") + "1,1,2,3\n2,4,5,6\n",
    ],
)
def test_the_usual_ways_to_write_a_table_are_understood(tmp_path, text):
    (tmp_path / "p.csv").write_text(text, encoding="utf-8")
    assert read_points(tmp_path / "p.csv").tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y,z\n1,2,3\n4,5\n", r"line 3: expected numbers x, y, z in 3 columns, got 2 columns"),
        ("x,y,z\nx,y,z\n1,2,3", "line 2"),
        ("1,2,3\n1,nan,3", "line 2"),
        ("1,two,3", r"line 1: expected numbers x, y, z, got 'two' as y"),
        ("x,y,z\n1,,3\n", r"line 2: expected numbers x, y, z, got '' as y"),
        ("x,y,z\n1,,3,4\n", "line 2.*got 4 columns"),
        ("x,y,z\n1,5,2,25,3,0\n", "line 2.*got 6 columns"),
        ("1,5,2,25,3,0\n", "line 1.*got 6 columns: name the columns in a first line"),
        ("x;y;z\n1,5;2.5;3\n", "line 2"),
        ("x;y;z\n1;2;3\n1.234,5;2;3\n", r"line 3.*'1.234,5' as x"),
        ("1;2;3\n1,2,3\n", "line 2"),
        ("1_0;2;3\n", "line 1"),
        ("1,inf,3\n", "line 1"),
        ("1e999,2,3\n", "line 1"),
        ("R,A,S\n1,2,3\n", "line 1: expected columns x, y, z, got no column x"),
        ("x,y,z,x\n1,2,3,4\n", "got 2 columns x"),
        ("x (cm),y (cm),z (cm)\n1,2,3\n", r"column 'x \(cm\)' must be in mm"),
        ("hello\n", "line 1: expected 3 columns"),
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
    "text",
    [
        "keV;weight\n20,5;0,1\n30,5;0,9\n",
        "20,5 0,1\n30,5 0,9\n",
        "weight,energy (keV)\n0.1,20.5\n0.9,30.5\n",
        "Energy [keV]\tN0\n20.5\t1\n30.5\t9\n",
    ],
)
def test_a_spectrum_is_read_by_the_names_of_its_columns(tmp_path, text):
    (tmp_path / "s.csv").write_text(text)
    spectrum = read_spectrum(tmp_path / "s.csv")
    assert spectrum.energies_kev == pytest.approx([20.5, 30.5])
    assert spectrum.weights == pytest.approx([0.1, 0.9])


def test_blanks_about_a_separator_mean_nothing(tmp_path):
    (tmp_path / "s.csv").write_text("20,5 ;0,1\n30,5 ;0,9\n")
    assert read_spectrum(tmp_path / "s.csv").energies_kev == pytest.approx([20.5, 30.5])
    (tmp_path / "s.csv").write_text("20,5 1\n")
    assert read_spectrum(tmp_path / "s.csv").energies_kev == pytest.approx([20.5])


def test_utf_16_of_a_spreadsheet_is_read(tmp_path):
    (tmp_path / "p.txt").write_text("x\ty\tz\r\n1,5\t2\t3\r\n", encoding="utf-16")
    assert read_points(tmp_path / "p.txt").tolist() == [[1.5, 2.0, 3.0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("eV,weight\n30000,1\n60000,1\n", "got no column energy|must be in keV"),
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
