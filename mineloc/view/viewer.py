"""The viewer itself, which the Rerun package brings along: a window for a person, a picture for a page.

Nothing is asked of a network: the viewer listens on this machine alone.
"""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rerun_cli
from rerun.experimental import ViewerClient

from mineloc.errors import OutputError
from mineloc.output import new_file
from mineloc.view.recorder import TIMELINE

_START_S = 60.0
_SETTLE_S = 1.0
_TRIES = 20
_LOCAL = "127.0.0.1"


def open_viewer(recording: Path) -> None:
    """Show a recording in a window, until it is closed.

    Raises:
        OutputError: the viewer did not start: no screen, or no graphics driver.
    """
    with tempfile.TemporaryFile() as log:
        command = [str(_executable()), "--bind", _LOCAL, "--port", str(_free_port()), str(recording)]
        code = subprocess.run(command, stdout=log, stderr=log, check=False).returncode
        if code != 0:
            log.seek(0)
            raise _no_viewer(recording, log.read())


def screenshot(
    recording: Path,
    picture: Path,
    *,
    at_ns: int | None,
    size: tuple[int, int] = (1600, 1000),
    overwrite: bool = False,
) -> Path:
    """Write a picture (PNG) of what a recording opens on, drawn without a screen.

    Args:
        recording: `.rrd`.
        picture: file to write.
        at_ns: where the time cursor stands; None leaves it where the recording opens.
        size: width and height in points; the picture may have more pixels.
        overwrite: replace `picture`.

    Raises:
        OutputError: no graphics driver, the viewer did not answer, or the picture cannot be written.
    """
    with new_file(picture, overwrite=overwrite) as temp, _headless(recording, size) as client:
        if at_ns is not None:
            client.set_time(TIMELINE, timestamp=np.datetime64(at_ns, "ns"), play_state="paused")
        before = b""
        # Chunks of the recording arrive one by one; the picture is done when it does not change any more.
        for _ in range(_TRIES):
            time.sleep(_SETTLE_S)
            client.save_screenshot(str(temp))
            now = temp.read_bytes()
            if now and now == before:
                return picture
            before = now
    return picture


@contextmanager
def _headless(recording: Path, size: tuple[int, int]) -> Generator[ViewerClient]:
    port = _free_port()
    command = [str(_executable()), "--headless", "--renderer", "vulkan", "--bind", _LOCAL, "--port", str(port)]
    command += ["--window-size", f"{size[0]}x{size[1]}", str(recording)]
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        # notices of the viewer would lie over the picture
        environment = os.environ | {"RUST_LOG": "error", "XDG_RUNTIME_DIR": folder}
        with log.open("wb") as output:
            process = subprocess.Popen(command, stdout=output, stderr=output, env=environment)
        try:
            yield _connected(process, port, recording, log)
        finally:
            process.terminate()
            try:
                process.wait(timeout=5)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _connected(process: subprocess.Popen[bytes], port: int, recording: Path, log: Path) -> ViewerClient:
    client: ViewerClient | None = None
    deadline = time.monotonic() + _START_S
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise _no_viewer(recording, log.read_bytes())
        try:
            client = client or ViewerClient.connect(f"rerun+http://{_LOCAL}:{port}/proxy")
            state = client.get_state()
        except (RuntimeError, OSError):  # not up yet
            time.sleep(0.3)
            continue
        if state.active_recording is not None and not state.loading:
            return client
        time.sleep(0.3)
    raise OutputError(recording, f"the viewer did not show it within {_START_S:.0f} s", todo="try again")


def _no_viewer(recording: Path, log: bytes) -> OutputError:
    text = log.decode(errors="replace")
    if "adapter" in text or "Vulkan" in text:
        return OutputError(
            recording, "cannot be drawn: no graphics driver", todo="install one: apt-get install mesa-vulkan-drivers"
        )
    if "display" in text.lower() or "wayland" in text.lower():
        return OutputError(
            recording, "cannot be shown: no screen", todo="use --save x.rrd or --screenshot x.png on this machine"
        )
    last = next((line for line in reversed(text.splitlines()) if line.strip()), "no message")
    return OutputError(recording, f"the viewer stopped: {last.strip()}", todo="use --save and open the file elsewhere")


def _executable() -> Path:
    folder = Path(rerun_cli.__file__).parent
    return folder / ("rerun.exe" if os.name == "nt" else "rerun")


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((_LOCAL, 0))
        return int(probe.getsockname()[1])
