"""What the names of files say: their natural order, and which of them are no scans."""

import re
from pathlib import Path

# Words for what lies beside scans, as whole words: "groundtruth.txt", "left_poses.csv", not "gtsam_0.csv". A pose or a
# time may also be what a scan is called by ("v1_pose0.csv", "time_003.csv"), so these must end the name, or begin it.
NO_SCAN = re.compile(
    r"(?<![a-z])(poses|time[_-]?stamps|traj(ectory|ectories)?|odom(etry)?|(ground[_-]?)?truth|gt|calib(ration)?|labels?"
    r"|readme)(?![a-z])|(?<![a-z])(pose|times?|(time[_-]?)?stamps?)\.|^pose(?![a-z])",
    re.IGNORECASE,
)


def is_companion(path: Path) -> bool:
    """Whether a table of numbers is called like a trajectory, times, a calibration or labels.

    >>> [is_companion(Path(name)) for name in ("groundtruth.txt", "times.txt", "t_000.csv", "gtsam_0.csv")]
    [True, True, False, False]
    """
    return NO_SCAN.search(path.name) is not None


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """What to sort by so that 2 stands before 10.

    >>> [path.name for path in sorted(map(Path, ("scan10.ply", "scan9.ply")), key=natural_key)]
    ['scan9.ply', 'scan10.ply']
    """
    parts = re.split(r"(\d+)", path.name.lower())
    # Not isdigit, which calls a circled or raised number a digit too, and int reads neither.
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in parts if part]
