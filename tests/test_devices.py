"""What tensors without values tell: no read-back from a device, and no device left behind."""

from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from torch_vdm import VDM, Haar, Observer, StationaryHaar, Steerable, VDMLoss, pair, vdm
from torch_vdm.model.cortex import Transform

each_transform = pytest.mark.parametrize(
    "transform", [Haar(), StationaryHaar(), Steerable()], ids=lambda t: type(t).__name__
)


@each_transform
@pytest.mark.parametrize("observer", [Observer.calibrated(), Observer.paper()])
def test_nothing_is_read_back_from_the_device(transform: Transform, observer: Observer) -> None:
    # A fake tensor has no values: to ask for one raises.
    with FakeTensorMode():
        metric = VDM(transform=transform, observer=observer, nonfinite="mask")
        loss = VDMLoss(transform=transform, observer=observer, nonfinite="mask")
        test = torch.rand(2, 3, 21, 34, requires_grad=True)
        reference = torch.rand(2, 3, 21, 34)
        with pytest.raises(Exception, match="_local_scalar_dense"):
            bool(test.sum() > 0.0)
        assert metric(test, reference).shape == (2, 1, 21, 34)
        assert metric.score(test, reference).shape == (2,)
        value = loss(test, reference, torch.ones(2, 1, 21, 34))
        (gradient,) = torch.autograd.grad(value, test)
        assert gradient.shape == test.shape
        # What is left to "raise" is the one check of each image, which these have no values for.
        assert VDM(transform=transform, observer=observer)(test, reference).shape == (2, 1, 21, 34)


@each_transform
def test_nothing_comes_from_the_processor_after_the_first_call(
    transform: Transform, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A copy to a GPU waits for it, and none can be captured in a graph.
    def refuse(*_: object, **__: object) -> None:
        raise AssertionError("numbers become a tensor")

    loss = VDMLoss(transform=transform, nonfinite="mask")
    test, reference = torch.rand(2, 1, 3, 21, 34)
    for call in range(2):
        loss.metric(test, reference)
        loss(test.requires_grad_(), reference).backward()
        if call == 0:
            for owner, name in ((torch, "tensor"), (torch, "as_tensor"), (torch, "from_numpy")):
                monkeypatch.setattr(owner, name, refuse)
            monkeypatch.setattr(torch.Tensor, "new_tensor", refuse)


class Order(TorchDispatchMode):
    """Notes what is computed, and what is read back."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]  # torch's own
        self.names: list[str] = []

    def __torch_dispatch__(  # noqa: D105  # torch's own
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        del types
        self.names.append(func.overloadpacket.__name__)
        return func(*args, **(kwargs or {}))


@each_transform
def test_a_gpu_is_asked_last_whether_images_are_finite(
    transform: Transform, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (pair, vdm):
        monkeypatch.setattr(module, "is_queued", lambda _: True)
    loss = VDMLoss(transform=transform)
    test, reference = torch.rand(2, 2, 3, 21, 34)
    for function in (loss.metric, loss.metric.power, loss.of_items):
        function(test, reference)  # the first call looks at the range
        with Order() as order:
            function(test, reference)
        assert order.names.count("_local_scalar_dense") == 1
        # After the last pixel, sums alone.
        after = order.names[order.names.index("_local_scalar_dense") :]
        assert set(after) <= {"_local_scalar_dense", "detach"}
    lost = test.clone()
    lost[1, 2, 3, 4] = torch.nan
    for images, name in (((lost, reference), "test"), ((test, lost), "reference")):
        for function in (loss.metric, loss.metric.power, loss.of_items):
            with pytest.raises(ValueError, match=rf"the {name}'s batch item 1, .* at x 4, y 3"):
                function(*images)


def test_nothing_is_read_back_by_sarnoffs_model() -> None:
    with FakeTensorMode():
        image = torch.rand(1, 3, 20, 30)
        assert VDM.sarnoff(30.0)(image, image.flip(-1)).shape == (1, 1, 20, 30)


@each_transform
def test_a_meta_call_gives_the_shape(transform: Transform) -> None:
    image = torch.empty(2, 3, 9, 14, device="meta")
    jnd = VDM(transform=transform).to("meta")(image, image)
    assert jnd.shape == (2, 1, 9, 14)
    assert jnd.is_meta


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
@each_transform
def test_a_gpu_gives_what_the_processor_gives(transform: Transform) -> None:
    test, reference = torch.rand(2, 2, 3, 40, 70, dtype=torch.float64)
    metric = VDM(transform=transform)
    expected = metric(test, reference)
    actual = metric.cuda()(test.cuda(), reference.cuda())
    torch.testing.assert_close(actual.cpu(), expected, rtol=1e-9, atol=1e-9)
