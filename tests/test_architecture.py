"""The drawing of the house, held as data: who may import whom; and that files and functions stay small."""

import ast
from pathlib import Path

import pytest
from architecture import Drawing, import_faults, levels, size_faults, sources

PROJECT = Path(__file__).resolve().parent.parent

# One row per level. A module imports only from rows above its own; those of one row do not import each other.
# "__init__" is the package's public face. A new file needs its name in a row.
ORDER = {
    "bbr_layer": """
        checks arrays threads once
        rotations
        geometry
        embedding pair trees tiles
        kernels
        kernels.cpu_compiling
        kernels.cpu_math
        kernels.cpu_walk kernels.cpu_turns kernels.cpu_axes
        kernels.cpu_adam kernels.cpu_mutual
        margins
        cloud_trees
        neighbours neighbourhoods distances
        normals buddies temperature spacing searches
        kernels.scene kernels.likeness
        kernels.squares
        kernels.blocks kernels.forward_mode kernels.soft_squares
        kernels.reference kernels.matched kernels.gpu_pairs
        kernels.cpu_limits kernels.cpu_apart
        kernels.cpu_pairs kernels.cpu_matched kernels.gpu_sweeps kernels.gpu_clouds
        kernels.cpu_clipping
        kernels.cpu_matched_adjoint kernels.cpu_sweeps kernels.cpu_forces kernels.cpu_dual kernels.cpu_dual_forces
        kernels.gpu_forces kernels.cpu_squares_adjoint
        kernels.cpu_features
        kernels.cpu_feature_rates
        kernels.cpu_dual_planes kernels.gpu
        kernels.cpu_kinds
        kernels.cpu_items
        kernels.cpu_batch kernels.cpu_course kernels.cpu_matched_course
        kernels.cpu
        kernels.choice
        kernels.soft
        loss_base
        losses
        matches directions start door thinning alike
        ellipsoid resistance
        confidence
        registration
        inner
        inner.schedules inner.charts inner.cotangents
        inner.adam inner.pose_gradient inner.gauss_newton
        inner.squares_step inner.squares_course
        inner.unroll
        inner.compiled_scene inner.matched_scene inner.walk inner.squares_walk
        inner.run inner.implicit
        backward transforms preparation
        stage
        named_stages descent
        buddies_loss fit_score
        starts
        layer
        atomic cloud_columns file_names
        cloud_tables cloud_formats cloud_writing trajectories
        clouds
        functional verdict
        two_clouds
        answer
        __init__
        __main__
    """,
    "models": """
        occupancy free_space scan_batch
        localisation free_poses edge_clouds
        buddy_term chamfer_terms residual_term
        registration_terms deep_mapping
        __init__
    """,
    "train": """
        __init__
        world_settings doors
        floor_plans
        routes worlds
        movers
        simulate
        simulation_files
        map_entropy occupancy_grid poses
        evaluate drawing ros_map
        curves pictures browser_map
        config scan_checks damage
        scans
        prepared pose_graph consensus
        surfaces edge_files report run_folder checkpoints spanning_tree
        beforehand
        shape_features refinement
        free_space_evidence planes
        scene moving_points
        places
        pair_registration outputs
        chain
        recognition given_motion loops
        agreement usual_speed
        edges
        known_edges
        groups schedule
        data_module
        alignment mapping_module
        surface_map
        keep_best
        settling
        training
        mapping
        console
        __main__
    """,
}
# The packages that each package may import, and then only their public names.
BELOW = {"bbr_layer": set(), "models": {"bbr_layer"}, "train": {"bbr_layer", "models"}}
# Top-level names that a package must not import. Lightning is imported by its own name everywhere.
FORBIDDEN = {
    "bbr_layer": {"lightning", "pytorch_lightning"},
    "models": {"lightning", "pytorch_lightning"},
    "train": {"pytorch_lightning"},
}
DRAWING = Drawing(ORDER, BELOW, FORBIDDEN)


@pytest.mark.parametrize("package", ORDER)
def test_the_list_names_the_files_that_exist(package):
    found, listed = set(sources(PROJECT, package)), set(levels(ORDER[package]))
    assert found - listed == set(), "files without a place in ORDER"
    assert listed - found == set(), "names in ORDER without a file"


@pytest.mark.parametrize("package", ORDER)
def test_no_name_is_listed_twice(package):
    assert len(ORDER[package].split()) == len(levels(ORDER[package]))


@pytest.mark.parametrize("package", ORDER)
def test_imports_point_down(package):
    assert import_faults(PROJECT, package, DRAWING) == []


@pytest.mark.parametrize("package", ORDER)
def test_files_and_functions_stay_small(package):
    assert size_faults(PROJECT, package) == []


@pytest.mark.parametrize("package", ORDER)
def test_every_module_says_what_it_is(package):
    files = sources(PROJECT, package)
    mute = [name for name, text in files.items() if not ast.get_docstring(ast.parse(text))]
    assert mute == [], "modules without a docstring"


def test_the_public_face_holds_names_and_nothing_else():
    body = ast.parse(sources(PROJECT, "bbr_layer")["__init__"]).body[1:]
    others = [ast.unparse(node) for node in body if not isinstance(node, ast.Import | ast.ImportFrom)]
    assert [line.split(" = ")[0] for line in others if not line.startswith("__all__")] == ["__version__"]


@pytest.fixture
def house(tmp_path: Path) -> Path:
    """A small project in which everything is allowed."""
    for package in ORDER:
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("import torch\n")
    (tmp_path / "bbr_layer" / "geometry.py").write_text("import bbr_layer.checks\n")
    (tmp_path / "bbr_layer" / "buddies.py").write_text("from bbr_layer import geometry\n")
    (tmp_path / "train" / "evaluate.py").write_text("import lightning\nfrom models import DeepMapping\n")
    for package in ORDER:
        assert import_faults(tmp_path, package, DRAWING) + size_faults(tmp_path, package) == []
    return tmp_path


@pytest.mark.parametrize(
    ("path", "text", "words"),
    [
        (
            "bbr_layer/geometry.py",
            "from bbr_layer.buddies import hard_buddies",
            "does not stand below buddies",
        ),
        ("bbr_layer/normals.py", "from bbr_layer import buddies", "does not stand below buddies"),
        ("bbr_layer/layer.py", "from bbr_layer import RigidMotion", "does not stand below __init__"),
        ("bbr_layer/layer.py", "def f():\n    import lightning.pytorch", "must not import lightning"),
        ("bbr_layer/layer.py", "from .geometry import RigidMotion", "a relative import"),
        ("bbr_layer/layer.py", "import models", "bbr_layer must not import models"),
        ("bbr_layer/unheard_of.py", "import bbr_layer.geometry", "does not stand below geometry"),
        ("models/occupancy.py", "import train", "models must not import train"),
        (
            "models/occupancy.py",
            "from bbr_layer.geometry import RigidMotion",
            "bbr_layer.geometry is not public",
        ),
        ("models/occupancy.py", "from bbr_layer import geometry", "bbr_layer.geometry is not public"),
        ("train/evaluate.py", "import pytorch_lightning", "must not import pytorch_lightning"),
        ("train/evaluate.py", "x = 1\n" * 201, "201 lines, at most 200"),
        ("train/evaluate.py", "def f():\n" + "    x = 1\n" * 40, "41 lines, at most 40"),
        ("train/evaluate.py", "def f(self, a, b, c, d, e, g): ...", "6 positional arguments, at most 5"),
    ],
)
def test_a_fault_is_found(house, path, text, words):
    (house / path).write_text(text)
    package = path.partition("/")[0]
    faults = import_faults(house, package, DRAWING) + size_faults(house, package)
    assert len(faults) == 1 and words in faults[0]


def test_an_empty_package_is_a_fault(house):
    for path in (house / "models").iterdir():
        path.unlink()
    with pytest.raises(AssertionError, match="models/ is missing or holds no Python file"):
        import_faults(house, "bbr_layer", DRAWING)
