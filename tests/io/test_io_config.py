import json

import pytest
import torch

from torchkcreg.io import read_config, write_config

CONFIG = {
    "preset": "paper",
    "beta": 1e-4,
    "grid_shape": [6, 6, 10],
    "material": None,
    "stages": [{"groups": 2, "bin": 1}],
}


@pytest.mark.parametrize("name", ["run.yaml", "run.yml", "run.json"])
def test_yaml_and_json_hold_the_same_configuration(tmp_path, name):
    path = tmp_path / name
    if name.endswith("json"):
        path.write_text(json.dumps(CONFIG))
    else:
        write_config(path, CONFIG)
    assert read_config(path) == CONFIG
    assert list(read_config(path)) == list(CONFIG)


def test_an_empty_file_is_an_empty_configuration(tmp_path):
    (tmp_path / "c.yaml").write_text("# nothing yet\n")
    assert read_config(tmp_path / "c.yaml") == {}


@pytest.mark.parametrize("text", ["1e-4", "1.0e-4", "1E-4", ".1e-3", "0.0001"])
def test_numbers_are_numbers_however_they_are_written(tmp_path, text):
    (tmp_path / "c.yaml").write_text(f"beta: {text}")
    assert read_config(tmp_path / "c.yaml") == {"beta": 1e-4}


def test_tensors_and_tuples_are_written_as_lists(tmp_path):
    write_config(tmp_path / "c.yaml", {"a": torch.eye(2), "b": (1, 2)})
    assert read_config(tmp_path / "c.yaml") == {"a": [[1.0, 0.0], [0.0, 1.0]], "b": [1, 2]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\na: 2\n", "line 2: key 'a' is given twice"),
        ("s:\n  b: 1\n  b: 2\n", "line 3: key 'b' is given twice"),
        ("a: [1, 2\nb: 3\n", "not valid YAML: line"),
        ("a: !!python/object/apply:os.getcwd []", "not valid YAML"),
        ("- a\n- b\n", "must hold keys and values, got list"),
        ("just text", "must hold keys and values, got str"),
        ("1: 2\n", "keys must be texts, got 1"),
    ],
)
def test_a_bad_configuration_is_refused_in_one_line_that_names_it(tmp_path, text, message):
    (tmp_path / "c.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"^configuration file .*c\.yaml.*{message}") as caught:
        read_config(tmp_path / "c.yaml")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("word", ["on", "off", "yes", "no", "On", "NO", "y"])
def test_words_that_old_yaml_takes_for_truth_stay_words(tmp_path, word):
    (tmp_path / "o.yaml").write_text(f"view_motion: {word}\n{word}: 1\nflag: true\n")
    assert read_config(tmp_path / "o.yaml") == {"view_motion": word, word: 1, "flag": True}
