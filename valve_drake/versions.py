"""What a run's numbers may depend on: versions of the program and of what it stands on."""

import importlib.metadata
import platform
import subprocess
from pathlib import Path


def versions() -> dict[str, str]:
    """What the run's numbers may depend on; nothing of the day or the machine's names."""
    names = ("valve-drake", "drake", "numpy", "opencv-python-headless", "mcap", "protobuf")
    out = {"python": platform.python_version(), "machine": platform.machine()}
    for name in names:
        try:
            out[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            out[name] = "unknown"
    try:
        here = Path(__file__).resolve().parent
        describe = ["git", "describe", "--always", "--dirty", "--abbrev=40"]
        git = subprocess.run(describe, cwd=here, capture_output=True, text=True, timeout=5)
        out["commit"] = git.stdout.strip() if git.returncode == 0 else "unknown"
    except (OSError, subprocess.SubprocessError):
        out["commit"] = "unknown"
    return out
