"""Peak memory of this process, from the system's own account; Linux only."""

from pathlib import Path

KIB_PER_MIB = 1024


def forget_peak() -> float:
    """Begin a new peak; MiB of resident memory held now."""
    Path("/proc/self/clear_refs").write_text("5")
    return _resident("VmRSS")


def peak() -> float:
    """MiB of resident memory at the peak since then."""
    return _resident("VmHWM")


def _resident(name: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) / KIB_PER_MIB
