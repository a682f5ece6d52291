"""The compiler's settings: the user's own again when no call needs others."""

import threading
from types import SimpleNamespace

import pytest

from torch_vdm.run.compiled import KEPT, MOST_FORMS, for_any_size


def in_two_threads(settings: object) -> None:
    """Enter in one thread and then another, and leave in the same order."""
    entered, left = threading.Event(), threading.Event()
    found: list[object] = []

    def other() -> None:
        with for_any_size():
            found.append(read())
            entered.set()
            left.wait(60.0)
            found.append(read())

    thread = threading.Thread(target=other)
    with for_any_size():
        thread.start()
        assert entered.wait(60.0)
    left.set()
    thread.join()
    # In force as long as the other thread needed it.
    assert found[0] == found[1] == (False, MOST_FORMS, KEPT)
    assert read() == settings


def read() -> tuple[object, ...]:
    from torch._dynamo import config as dynamo
    from torch._functorch import config as gradients
    from torch.fx.experimental import _config as shapes

    return shapes.use_duck_shape, dynamo.recompile_limit, gradients.activation_memory_budget


def test_two_threads_leave_a_threads_own_settings_as_they_were() -> None:
    in_two_threads(read())


def test_two_threads_leave_the_processs_settings_as_they_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # As torch had them before each thread had its own.
    monkeypatch.setattr("torch._dynamo.config", SimpleNamespace(recompile_limit=8))
    budget = SimpleNamespace(activation_memory_budget=1.0)
    monkeypatch.setattr("torch._functorch.config", budget)
    monkeypatch.setattr("torch.fx.experimental._config", SimpleNamespace(use_duck_shape=True))
    in_two_threads((True, 8, 1.0))


def test_settings_return_after_an_error() -> None:
    before = read()
    with pytest.raises(RuntimeError, match="out"), for_any_size():
        raise RuntimeError("out")
    assert read() == before
