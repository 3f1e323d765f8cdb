"""Where and with what a benchmark ran: the `environment` of a record."""

import datetime
import pathlib
import platform
import subprocess

import jax

from jaxrender import doctor


def environment() -> dict[str, str | int | bool | None]:
    """Commit, versions, device and machine, flat and JSON-ready."""
    machine, device = doctor.examine_machine(), jax.devices()[0]
    commit, changed = _commit()
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d"),
        "commit": commit,
        "uncommitted_changes": changed,
        "python": platform.python_version(),
        **{name: doctor.package_version(name) for name in ("jaxrender", "jax", "jaxlib", "numpy", "embreex")},
        "device": f"{device.platform} ({device.device_kind})" if device.platform != "cpu" else "cpu",
        "system": machine["system"],
        "cpu": machine["cpu"],
        "cores": machine["cores"],
        "memory_bytes": machine["memory_bytes"],
    }


def _commit() -> tuple[str | None, bool | None]:
    """The commit of the source, and whether tracked files differ from it; None outside a repository."""
    folder = pathlib.Path(__file__).resolve().parents[1]
    if not (folder / ".git").exists():  # an installed copy may lie inside somebody else's repository
        return None, None
    try:
        commit = _git(folder, "rev-parse", "HEAD").strip()
        return commit, bool(_git(folder, "status", "--porcelain", "--untracked-files=no").strip())
    except (OSError, subprocess.SubprocessError):
        return None, None


def _git(folder: pathlib.Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=30).stdout
