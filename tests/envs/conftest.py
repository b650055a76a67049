"""Choose the OpenGL before any test module imports dm_control, which reads the choice once; ask whether it draws."""

import subprocess
import sys

import pytest

from sb3_sample.envs.base import select_gl_backend

select_gl_backend()


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skip where MuJoCo cannot open an OpenGL context at all (asked in a process of its own: it may crash)."""
    code = (
        "from sb3_sample.envs.base import select_gl_backend\n"
        "select_gl_backend()\n"
        "import mujoco\n"
        "renderer = mujoco.Renderer(mujoco.MjModel.from_xml_string('<mujoco/>'), 16, 16)\n"
        "renderer.update_scene(mujoco.MjData(renderer.model))\n"
        "renderer.render()\n"
    )
    probe = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    if probe.returncode != 0:
        pytest.skip(f"MuJoCo cannot draw here: {probe.stderr[-300:]}")
