"""The settings of the mapper: what a config.yaml may hold, and the sentence for one that holds something else."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from bbr_layer import atomic_write
from models import REGISTRATION_TERMS, TermSettings

Share = Annotated[float, Field(ge=0, le=1)]
Count = Annotated[int, Field(ge=1)]
# 32 bits: what numpy, torch and Lightning all take.
Seed = Annotated[int, Field(ge=0, lt=2**32)]
# The words that choose a registration term: the name models/ knows it by, and its settings. The best-buddies losses
# each have a word of their own, the paper's.
TERMS = {name: (name, TermSettings()) for name in REGISTRATION_TERMS if name != "buddy"} | {
    loss: ("buddy", TermSettings(loss=loss)) for loss in ("softBBS", "softBD", "N", "F")
}
# First learning rates: of free poses in point spacings a step, measured on DeepMapping's v1_pose0; of L-Net's weights.
LOCALISATION_RATES = {"direct": 0.3, "network": 3e-3}
# YAML's own values, nested by section.
SettingsTree = Mapping[str, object]


class Settings(BaseModel):
    """Settings that refuse what they do not know and never change once made."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class EdgeConfig(Settings):
    """Which scans are registered with which.

    Parameters
    ----------
    window: each scan is registered with this many scans after it.
    loops_per_scan: most loop candidates of one scan, 0 for none.
    rounds: how often loop candidates are sought from the corrected poses, and up to four times as often while scans
        still move; 0 for no loops.
    points: most points of a scan that a registration reads.
    refined_points: most points of a scan that the last refinement of all poses reads.
    """

    window: Count = 3
    loops_per_scan: Annotated[int, Field(ge=0)] = 4
    rounds: Annotated[int, Field(ge=0)] = 2
    points: Annotated[int, Field(ge=10)] = 1000
    refined_points: Annotated[int, Field(ge=10)] = 5000


class TrainingConfig(Settings):
    """How the map is trained once the edges are there.

    Parameters
    ----------
    term: registration term, one of ``TERMS``.
    epochs: passes over all edges; 0 keeps the edges' map.
    adjust: begin at the poses at which the map of all scans is thinnest, where the score agrees.
    keep: "best", the poses that align held-out points best, the starting ones included; "last", where the training
        ends, better or not: to compare registration terms.
    warm_up, settle: shares of the epochs, at most 1 together, at the beginning and at the end, in which only the
        occupancy network learns: first the starting map, before it may move a pose; at last, earlier where poses no
        longer move, the map of the poses that were kept.
    group: consecutive scans in one step; the partners of their loop edges come on top.
    points: most points of a scan in one step, drawn anew in every epoch.
    free_samples: points of free space per ray.
    occupancy_weight, registration_weight: of the two losses.
    localisation: what corrects poses: "direct", a correction of its own for each scan, or "network", L-Net.
    localisation_rate: first learning rate of that (Adam, cosine to 0); None: ``LOCALISATION_RATES``.
    occupancy_rate: first learning rate of M-Net.
    encoder: of L-Net: "ordered" for 2D scans in the order of their rays, "unordered" for any, "auto" for ordered in
        2D and unordered in 3D.
    size: of L-Net and M-Net: "small" for seconds on a CPU, "paper" for DeepMapping's networks, encoder included.
    """

    term: str = "F"
    epochs: Annotated[int, Field(ge=0)] = 40
    adjust: bool = True
    keep: Literal["best", "last"] = "best"
    warm_up: Share = 0.2
    settle: Share = 0.2
    group: Annotated[int, Field(ge=2)] = 8
    points: Annotated[int, Field(ge=10)] = 256
    free_samples: Count = 3
    occupancy_weight: Annotated[float, Field(ge=0)] = 0.1
    registration_weight: Annotated[float, Field(ge=0)] = 0.9
    localisation: Literal["direct", "network"] = "direct"
    localisation_rate: Annotated[float, Field(gt=0)] | None = None
    occupancy_rate: Annotated[float, Field(gt=0)] = 5e-3
    encoder: Literal["auto", "ordered", "unordered"] = "auto"
    size: Literal["small", "paper"] = "small"

    @property
    def first_localisation_rate(self) -> float:
        """The rate given, or that of the kind of localisation."""
        rate = self.localisation_rate
        return LOCALISATION_RATES[self.localisation] if rate is None else rate

    @model_validator(mode="after")
    def _not_more_than_all(self) -> "TrainingConfig":
        if self.warm_up + self.settle > 1 + 1e-9:  # decimal shares may add up to a rounding more
            both = f"warm_up {self.warm_up} and settle {self.settle}"
            raise ValueError(f"{both} are more than all epochs; make the two at most 1 together")
        return self

    @field_validator("term")
    @classmethod
    def _known_term(cls, name: str) -> str:
        if name not in TERMS:
            raise ValueError(f"it must be one of {', '.join(TERMS)}")
        return name


class MapConfig(Settings):
    """Everything ``map`` can be told, apart from where its files are.

    Parameters
    ----------
    seed: of the networks' first weights, the drawn points and the order of the groups; below 2^32.
    stride: every how many-th scan is used.
    device: "cpu", "cuda", "mps", or "auto" for the best there is.
    """

    seed: Seed = 0
    stride: Count = 1
    device: Literal["auto", "cpu", "cuda", "mps"] = "cpu"
    edges: EdgeConfig = EdgeConfig()
    training: TrainingConfig = TrainingConfig()


def load_config(path: str | Path | None, changes: SettingsTree | None = None) -> MapConfig:
    """Settings from a YAML file (the defaults without one), with ``changes`` on top.

    Parameters
    ----------
    path: a file as ``dump_config`` writes it; keys that are left out keep their defaults.
    changes: nested as the file is, as in ``{"training": {"epochs": 5}}``.

    Raises
    ------
    FileNotFoundError: there is no such file.
    ValueError: it is no YAML, has an unknown key or a value that does not fit.
    """
    tree: SettingsTree = {} if path is None else _read_yaml(Path(path))
    merged = dict(tree)
    for key, change in (changes or {}).items():
        below = merged.get(key)
        if isinstance(change, Mapping) and isinstance(below, Mapping):
            merged[key] = dict(below) | dict(change)
        else:
            merged[key] = change
    try:
        return MapConfig.model_validate(merged)
    except ValidationError as error:
        raise ValueError(f"{path or 'settings'}: {_first_fault(error)}") from error


def dump_config(config: MapConfig, path: str | Path) -> None:
    """Write every setting, defaults included, so that ``load_config`` reads the same again.

    Raises
    ------
    OSError: the file cannot be written.
    """
    with atomic_write(path) as temporary:
        temporary.write_text(yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False), encoding="utf-8")


def _read_yaml(path: Path) -> SettingsTree:
    if not path.is_file():
        raise FileNotFoundError(f"{path}: there is no such configuration file; check the name")
    try:
        tree = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        where = f", line {error.problem_mark.line + 1}" if hasattr(error, "problem_mark") else ""
        raise ValueError(f"{path}{where}: this is no YAML; write lines such as 'seed: 1'") from error
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise ValueError(f"{path} holds {type(tree).__name__}, not settings; write lines such as 'seed: 1'")
    return tree


def _first_fault(error: ValidationError) -> str:
    """One sentence: where, what came, what is wanted."""
    fault = error.errors()[0]
    place = ".".join(str(part) for part in fault["loc"])
    if fault["type"] == "extra_forbidden":
        section: type[BaseModel] = MapConfig
        for part in fault["loc"][:-1]:
            annotation = section.model_fields[str(part)].annotation
            assert isinstance(annotation, type) and issubclass(annotation, BaseModel)
            section = annotation
        return f"{place} is no setting; there are {', '.join(section.model_fields)}"
    wanted = fault["msg"].removeprefix("Value error, ")
    return f"{place} is {fault['input']!r}: {wanted[0].lower()}{wanted[1:]}"
