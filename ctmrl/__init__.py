"""Offline meta-reinforcement learning with cross-task contexts (CTMRL), and its relatives."""
