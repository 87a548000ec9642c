"""Settings: defaults, files, what was typed on top, and the sentence for what is no setting."""

import re

import pytest

from train.config import TERMS, MapConfig, dump_config, load_config


def test_what_is_written_is_read_again(tmp_path):
    config = load_config(None, {"seed": 3, "training": {"term": "softBD", "epochs": 7}})
    dump_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config
    assert config.training.term == "softBD" and config != MapConfig()


def test_changes_go_on_top_of_the_file(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("stride: 2\ntraining:\n  epochs: 9\n  term: chamfer\n")
    config = load_config(path, {"training": {"epochs": 4}})
    assert (config.stride, config.training.epochs, config.training.term) == (2, 4, "chamfer")


def test_an_empty_file_holds_the_defaults(tmp_path):
    (tmp_path / "config.yaml").touch()
    assert load_config(tmp_path / "config.yaml") == MapConfig()


@pytest.mark.parametrize("term", TERMS)
def test_every_term_is_one_word(term):
    assert load_config(None, {"training": {"term": term}}).training.term == term


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("epochs: 3", "epochs is no setting; there are seed, stride"),
        ("training: {epoch: 3}", "training.epoch is no setting; there are term, epochs"),
        ("training: {term: icp}", "training.term is 'icp': it must be one of none, chamfer"),
        ("training: {epochs: -1}", "training.epochs is -1: input should be greater than or equal to 0"),
        ("training: {warm_up: 0.8, settle: 0.3}", "warm_up 0.8 and settle 0.3 are more than all epochs; make the two"),
        ("training: {warm_up: 0.9}", "training is {'warm_up': 0.9}: warm_up 0.9 and settle 0.2 are more than all"),
        ("edges: {window: two}", "edges.window is 'two': input should be a valid integer"),
        ("training: 5", "training is 5: "),
        ("device: tpu", "device is 'tpu': input should be"),
        ("seed: [", "line 1: this is no YAML"),
        ("- a list", "holds list, not settings"),
    ],
)
def test_a_wrong_file_is_told_in_one_sentence(tmp_path, text, words):
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(words)) as caught:
        load_config(path)
    assert str(caught.value).startswith(str(path)) and "\n" not in str(caught.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such configuration file"):
        load_config(tmp_path / "config.yaml")


def test_settings_do_not_change():
    with pytest.raises(ValueError, match="frozen"):
        MapConfig().seed = 1


def test_shares_may_be_all_of_the_epochs():
    training = load_config(None, {"training": {"warm_up": 0.7, "settle": 0.3}}).training
    assert training.warm_up + training.settle == 1
