"""Soft actor-critic for many tasks at once: one learner of batched networks, the tasks apart."""
