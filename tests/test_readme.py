"""The README's example runs and its promises hold."""

import re
from pathlib import Path

README = (Path(__file__).resolve().parent.parent / "README.md").read_text()


def test_the_example_runs_and_finds_the_motion(capsys):
    example, training = re.findall(r"```python\n(.*?)```", README, flags=re.DOTALL)
    names: dict = {}
    exec(compile(example, "README.md", "exec"), names)
    words, error = capsys.readouterr().out.rsplit(maxsplit=1)
    assert words == "converged" and float(error) < 1e-2
    assert names["Q"].grad.abs().max() > 0
    names["network"] = lambda Q: 1.01 * Q
    exec(compile(training, "README.md", "exec"), names)
    names["loss"].backward()
    assert names["loss"] > 0


def test_the_folders_exist():
    root = Path(__file__).resolve().parent.parent
    folders = re.findall(r"^\| `(\w+)/` \|", README, flags=re.MULTILINE)
    assert len(folders) >= 6 and all((root / folder).is_dir() for folder in folders)
