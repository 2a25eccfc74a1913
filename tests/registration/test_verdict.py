"""What is said of a registration: right ones are ok, wrong ones are not, each for its own reason."""

from dataclasses import replace

import pytest
import torch
from small_scene import RIGID, SCREW, image, pose, scene

from torchkcreg.optimization.parameters import ParameterBlock, ParameterBlocks
from torchkcreg.registration import RegistrationConfig, RegistrationData, Stage, Trainer
from torchkcreg.registration.uncertainty import Uncertainty, views_a_side
from torchkcreg.registration.verdict import Diagnostics, Rival, judge
from torchkcreg.scene.parameter_blocks import PhysicsParameters

CONFIG = RegistrationConfig(stages=RIGID)
GOOD = Diagnostics(gc=[0.95, 0.9], misfit=0.01, node_std_mm=0.02, seen=[1.0, 0.8], strain=1e-4)
BAD = {
    "gc": ("failed", [0.9, 0.1]),
    "seen": ("failed", [0.01, 0.0]),
    "folds": ("failed", True),
    "misfit": ("doubtful", 0.1),
    "node_std_mm": ("doubtful", float("nan")),
    "strain": ("doubtful", 0.01),
    "surprise": ("doubtful", 5.0),
    "converged": ("doubtful", False),
    "at_bounds": ("doubtful", ["scatter"]),
    "rival": ("doubtful", Rival(distance_mm=16.0, misfit=0.011, best_misfit=0.01)),
    "undone": ("doubtful", {"3": "it lost"}),
}


def test_a_good_registration_is_ok() -> None:
    assert judge(GOOD) == ("ok", [])


@pytest.mark.parametrize("name", BAD)
def test_each_flaw_alone_is_told(name: str) -> None:
    expected, value = BAD[name]
    status, reasons = judge(replace(GOOD, **{name: value}))
    assert status == expected
    assert len(reasons) == 1


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("gc", [0.9, float("nan"), 0.9], "failed"),
        ("gc", [float("nan"), 0.9], "failed"),
        ("misfit", float("nan"), "failed"),
        ("strain", float("nan"), "doubtful"),
        ("surprise", float("inf"), "doubtful"),
        ("seen", [1.0, float("nan")], "doubtful"),
        ("view_motion_mm", float("nan"), "doubtful"),
    ],
)
def test_a_figure_that_is_not_a_number_is_never_ok(name: str, value: object, expected: str) -> None:
    status, reasons = judge(replace(GOOD, **{name: value}))
    assert status == expected
    assert f"{name} is not a number" in reasons


def test_an_error_that_nothing_is_measured_with_fails_unless_a_single_view_leaves_depth_open() -> None:
    status, reasons = judge(replace(GOOD, node_std_mm=3.3))
    assert status == "failed" and "do not tell where the implant is" in reasons[0]
    assert judge(replace(GOOD, node_std_mm=1.9))[0] == "doubtful"
    assert judge(replace(GOOD, node_std_mm=3.3, gc=[0.95], seen=[1.0]))[0] == "doubtful"


def test_inverted_images_are_named() -> None:
    status, reasons = judge(replace(GOOD, gc=[-0.9, -0.8]))
    assert status == "failed" and any("inverted" in reason for reason in reasons)
    assert not any("inverted" in reason for reason in judge(replace(GOOD, gc=[-0.1, 0.9]))[1])


def test_a_view_that_hardly_shows_the_implant_is_named() -> None:
    status, (reason,) = judge(replace(GOOD, seen=[1.0, 0.1]))
    assert status == "doubtful"
    assert "view 1" in reason


def test_what_would_help_is_what_the_error_comes_from() -> None:
    _, (views,) = judge(replace(GOOD, node_std_mm=0.2))
    _, (screws,) = judge(replace(GOOD, node_std_mm=0.2, screws_found=4))
    _, (geometry,) = judge(replace(GOOD, node_std_mm=0.2, view_motion_mm=0.25))
    assert "views from other sides would help" in views and "their list" not in views
    assert "4 screws that were found, not given: their list" in screws
    assert "the views are off the geometry by 0.25 mm" in geometry and "other sides" not in geometry


def registered(data: RegistrationData, config: RegistrationConfig = CONFIG, **start):
    return Trainer(scene(config, **start), data, config).fit()


def test_the_right_images_are_ok() -> None:
    result = registered(image(scene(CONFIG, components=[SCREW])), components=[SCREW], implant_to_world=pose(1.0, 1.0))
    assert result.status == "ok", result.warnings
    assert result.warnings == []
    assert result.diagnostics["node_std_mm"] < 0.1


def test_what_explains_little_and_is_held_by_little_fails() -> None:
    status, reasons = judge(replace(GOOD, misfit=0.3, node_std_mm=0.6))
    assert status == "failed"
    assert "something else" in reasons[0]


@pytest.mark.parametrize("what", ["blank", "flipped", "noise"])
def test_images_of_something_else_fail(what: str) -> None:
    data = image(scene(CONFIG))
    lines = {
        "blank": torch.zeros_like(data.line_integrals),
        "flipped": data.line_integrals.flip(-1, -2),
        "noise": torch.rand(data.line_integrals.shape, generator=torch.Generator().manual_seed(0)),
    }[what]
    result = registered(replace(data, line_integrals=lines))
    assert result.status == "failed"
    assert result.warnings


def test_an_implant_that_leaves_the_images_is_told() -> None:
    data = image(scene(CONFIG))
    mask = torch.zeros_like(data.mask)
    mask[:, :70] = True
    result = registered(replace(data, mask=mask))
    assert min(result.diagnostics["seen"]) < 0.3
    assert any("is seen in view" in reason for reason in result.warnings)


def test_a_parameter_that_ends_at_its_bound_is_named() -> None:
    physical = RegistrationConfig(material="steel", stages=(Stage(estimate=("scatter", "blur")),))
    here = scene(physical)
    assert PhysicsParameters(here.intensity, ("scatter", "blur"), 1.0, 1.0).at_bounds(0.01) == []
    with torch.no_grad():
        here.intensity.get_parameter("scatter").fill_(0.9)
    assert PhysicsParameters(here.intensity, ("scatter", "blur"), 1.0, 1.0).at_bounds(0.01) == ["scatter"]


def test_a_bound_where_a_parameter_is_likely_to_be_says_nothing() -> None:
    """Nothing may be scattered from what a limb removes, but scanners without any scatter there are hardly."""
    physical = RegistrationConfig(material="steel", stages=(Stage(estimate=("scatter", "removed")),))
    here = scene(physical)
    nuisance = PhysicsParameters(here.intensity, ("scatter", "removed"), 1.0, 1.0)
    assert float(here.intensity.get_parameter("scatter_removed")) == 0.0
    assert nuisance.at_bounds(0.01) == []
    with torch.no_grad():
        here.intensity.get_parameter("scatter").fill_(0.0)
    assert PhysicsParameters(here.intensity, ("scatter", "removed"), 1.0, 1.0).at_bounds(0.01) == ["scatter"]


def test_screws_that_were_found_ask_for_more() -> None:
    same = replace(GOOD, node_std_mm=0.09)
    assert judge(same)[0] == "ok"
    status, (reason,) = judge(replace(same, screws_found=4))
    assert status == "doubtful"
    assert "4 screws that were found" in reason


def test_views_from_one_side_count_as_one() -> None:
    nodes = torch.cartesian_prod(*(torch.linspace(-x, x, 5).double() for x in (6.0, 2.0, 90.0)))

    def sources(degrees: list[float], heights: list[float]) -> torch.Tensor:
        angle, z = torch.deg2rad(torch.tensor(degrees)).double(), torch.tensor(heights).double()
        return torch.stack([400 * angle.cos(), 400 * angle.sin(), z], dim=-1)

    assert views_a_side(sources([90, 91, 92], [120.0, 0.0, -120.0]), nodes) == pytest.approx(3.0, abs=0.05)
    assert views_a_side(sources([0, 60, 120], [120.0, 0.0, -120.0]), nodes) == pytest.approx(1.0, abs=0.01)
    pairs = views_a_side(sources([0, 1, 90, 91], [0.0, 10.0, 0.0, 10.0]), nodes)
    assert pairs == pytest.approx(2.0, abs=0.05)


def test_blocks_of_one_side_and_found_screws_widen_the_covariance() -> None:
    class Free(ParameterBlock):
        num_parameters = 2

    generator = torch.Generator().manual_seed(0)
    jacobian = torch.randn(2, 3, 2, 48, 48, generator=generator, dtype=torch.float64)

    def white() -> torch.Tensor:
        return torch.randn(3, 2, 48, 48, generator=generator, dtype=torch.float64)

    def covariance(residuals: torch.Tensor, **known) -> torch.Tensor:
        return Uncertainty.of(
            jacobian,
            residuals,
            ParameterBlocks({"free": Free()}),
            lambda p: p.new_zeros(len(p)),
            torch.zeros(2).double(),
            pixel_mm=1.0,
            **known,
        ).covariance

    # White residuals with a variance of one have the covariance of a least squares fit, on average.
    flat = jacobian.flatten(1)
    least_squares = torch.linalg.inv(flat @ flat.T)
    mean = torch.stack([covariance(white()) for _ in range(400)]).mean(0)
    torch.testing.assert_close(mean, least_squares, rtol=0, atol=0.05 * float(least_squares.max()))
    residuals = white()
    alone = covariance(residuals)
    torch.testing.assert_close(covariance(residuals, views_a_side=3.0), 3 * alone)
    torch.testing.assert_close(covariance(residuals, screws_found=True), 1.5**2 * alone)
    torch.testing.assert_close(covariance(residuals, screws_found=True, views_a_side=4.0), 8 * 1.5**2 * alone)


def test_a_panel_that_is_sharper_than_its_pixels_says_nothing() -> None:
    physical = RegistrationConfig(material="steel", stages=(Stage(estimate=("scatter", "blur")),))
    here = scene(physical)
    with torch.no_grad():
        here.intensity.get_parameter("blur_sigma_px").fill_(0.1)
    assert PhysicsParameters(here.intensity, ("scatter", "blur"), 1.0, 1.0).at_bounds(0.01) == []
    with torch.no_grad():
        here.intensity.get_parameter("blur_sigma_px").fill_(5.0)
    assert PhysicsParameters(here.intensity, ("scatter", "blur"), 1.0, 1.0).at_bounds(0.01) == ["blur"]


@pytest.mark.parametrize(
    ("flaw", "text"),
    [
        ({"misfit": 0.1}, "10 % of the images' contrast is left unexplained"),
        ({"seen": [0.02, 0.0]}, "no view shows more than 2 % of the implant"),
        ({"seen": [1.0, 0.2]}, "less than 30 % of the implant is seen in view 1"),
        ({"strain": 0.0123}, "the implant is strained by 1.23 % (RMS)"),
        ({"surprise": 9.0}, "it takes loads 3.0 times as strong"),
        ({"gc": [0.95, 0.5]}, "gradient correlation is 0.50, less than 0.6"),
        ({"gc": [0.95, 0.2]}, "gradient correlation is 0.20 in view 1"),
        ({"node_std_mm": 0.25}, "off by 0.250 mm (RMS), more than 0.11 mm: views"),
        ({"misfit": 0.3, "node_std_mm": 0.7}, "30 % of the images' contrast is left unexplained and the nodes are"),
        ({"rival": Rival(16.04, 0.011, 0.01)}, "fits nearly as well 16.0 mm away"),
        ({"undone": {"3": "it lost"}}, "stage 3 was undone: it lost"),
        ({"at_bounds": ["scatter"]}, "scatter ended at its bound"),
    ],
)
def test_a_reason_has_the_figure_and_its_limit(flaw: dict, text: str) -> None:
    assert any(text in reason for reason in judge(replace(GOOD, **flaw))[1])


@pytest.mark.parametrize(
    "right",
    [
        {"misfit": 0.08},
        {"node_std_mm": 0.11},
        {"gc": [0.6, 0.9]},
        {"seen": [1.0, 0.3]},
        {"strain": 0.0035},
        {"surprise": 4.0},
        {"rival": Rival(2.0, 0.01, 0.01)},
        {"rival": Rival(16.0, 0.0121, 0.01)},
        {"undone": {"1": "it lost"}},
        {"screws_found": 3, "node_std_mm": 0.085},
    ],
)
def test_a_figure_at_its_limit_is_ok(right: dict) -> None:
    assert judge(replace(GOOD, **right)) == ("ok", [])


@pytest.mark.parametrize("flaw", [{"gc": [0.3, 0.9]}, {"seen": [0.05, 0.05]}, {"node_std_mm": 2.0}, {"misfit": 0.2}])
def test_a_figure_at_the_limit_of_failure_is_doubtful(flaw: dict) -> None:
    assert judge(replace(GOOD, **flaw))[0] == "doubtful"
