"""Choose the OpenGL before any test module imports dm_control, which reads the choice once."""

from sb3_sample.envs.base import select_gl_backend

select_gl_backend()
