"""The package's front door."""

import herglotz as hz


def test_every_public_name_resolves_again_and_again():
    # fails if a lazily loaded name is shadowed by a room of the same name after its first use
    import herglotz.verify  # noqa: F401  a room, imported as a user would

    for _ in range(2):
        for name in hz.__all__:
            value = getattr(hz, name)
            assert callable(value), name
