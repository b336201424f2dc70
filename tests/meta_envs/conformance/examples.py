"""Where the faulty environments are."""


def broken(name: str) -> str:
    """`module:Class` of a faulty environment."""
    return f"tests.meta_envs.conformance.broken:{name}"
