"""The commands of `python -m meta_envs`, one module each: its options and what it does."""
