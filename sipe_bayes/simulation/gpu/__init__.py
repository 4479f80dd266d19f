"""The engine on a GPU, by mujoco-warp."""
