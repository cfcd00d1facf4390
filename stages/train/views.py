"""Training views: which frame and cameras a step sees, and their pictures, cropped to the subject.

The choice is a function of (seed, step) alone. So a resumed run continues as if it had never stopped, and a
thread can prepare the views of the next step while a step is computed.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from stages.shared.body import BodyModel, Poses, posed_vertices
from stages.shared.body.posed import pose_tensors
from stages.shared.capture import Camera
from stages.shared.capture.exposure import Exposure
from stages.shared.capture.take import MASK_THRESHOLD, box_around
from stages.shared.errors import MissingInput
from stages.shared.layers import BODY, NO_LABEL
from stages.shared.losses.picture import rasterize_silhouette
from stages.train.config import DEFAULT_METHOD
from stages.train.methods import METHODS, Method
from stages.train.random_crop import RandomCrop
from stages.train.take_sequence import TakeSequence

_BACKGROUND, _UNKNOWN = 250, 255
_MARGIN = 8
_BLANK_SIDE = 32  # pixels of a view that shows nobody
CACHE_BYTES = 1 << 30  # of decoded crops
CACHE_BYTES_PER_PIXEL = 6  # image 3, mask, layer, silhouette
ViewKey = tuple[int, str, float, RandomCrop | None]
"""Frame, camera, scale, crop."""
Key = TypeVar("Key", bound=Hashable)
Value = TypeVar("Value")


@dataclass(frozen=True)
class View:
    """One picture of the subject, cropped.

    Attributes:
        camera: of the crop. frame: number.
        image: (H, W, 3) sRGB 0..1. inside: (H, W) 1 on the subject. valid: (H, W) 0 on the mask's edge, where
            pixels mix subject and background.
        labels: (H, W, L) one-hot layers, all 0 on the background. known: (H, W) 0 where the layer is unknown.
        silhouette: (H, W) 1 on the silhouette of the body without garments.
    """

    camera: Camera
    frame: int
    image: Tensor
    inside: Tensor
    valid: Tensor
    labels: Tensor
    known: Tensor
    silhouette: Tensor

    def to(self, device: torch.device) -> View:
        """The same view with its tensors on `device`."""
        tensors = (self.image, self.inside, self.valid, self.labels, self.known, self.silhouette)
        return View(self.camera, self.frame, *(tensor.to(device) for tensor in tensors))


@dataclass(frozen=True)
class StepChoice:
    """What a step sees: a frame, some cameras, a background colour for each (K, 3)."""

    step: int
    frame: int
    cameras: tuple[str, ...]
    backgrounds: NDArray[np.float32]


def choose(seed: int, step: int, frames: Sequence[int], cameras: Sequence[str], views: int) -> StepChoice:
    """Every frame once per epoch in a new order; cameras without repetition within a step."""
    epoch, place = divmod(step, len(frames))
    order = np.random.default_rng([seed, 1, epoch]).permutation(len(frames))
    generator = np.random.default_rng([seed, 2, step])
    chosen = generator.permutation(len(cameras))[: min(views, len(cameras))]
    backgrounds = generator.random((len(chosen), 3)).astype(np.float32)
    return StepChoice(step, frames[order[place]], tuple(cameras[index] for index in chosen), backgrounds)


class TrainingViews:
    """Pictures of takes, decoded once and cached while they fit into memory.

    Arguments:
        sequence: the takes. poses: row = frame number. body: model of the poses.
        layers: names, inner to outer; labels of other layers count as unknown.
        method: says which labels show which layer.
        exposures: camera to what its colours are freed of. cache_bytes: most memory for decoded crops.
    """

    margin = _MARGIN  # px around the subject, where pictures are cut

    def __init__(
        self,
        sequence: TakeSequence,
        poses: Poses,
        body: BodyModel,
        layers: Sequence[str],
        method: Method = METHODS[DEFAULT_METHOD],
        exposures: Mapping[str, Exposure] = {},
        cache_bytes: int = CACHE_BYTES,
    ) -> None:
        self.sequence, self.poses, self.body, self.layers = sequence, poses, body, tuple(layers)
        self.exposures, self.cache_bytes = exposures, cache_bytes
        self._cached_bytes = 0
        self._cache_lock = threading.Lock()
        self._posed: dict[int, NDArray[np.float32]] = {}
        self._blank: set[tuple[str, int]] = set()
        self.prefetcher: Prefetcher[ViewKey, View] = Prefetcher(self._make)
        self._crops: OrderedDict[tuple[int, str], _Crop] = OrderedDict()
        self._layer_of_id = np.full(256, _UNKNOWN, dtype=np.uint8)
        self.layer_of_label = method.layer_of_label(self.layers)
        for label, layer in self.layer_of_label.items():
            self._layer_of_id[label] = self.layers.index(layer)

    def blank_views(self) -> str:
        """Cameras and frames of the views read so far that show nobody, as "cam0: 4, 5; cam1: 7"."""
        frames: dict[str, list[str]] = {}
        for camera, frame in sorted(self._blank):
            frames.setdefault(camera, []).append(self.sequence.frame_name(frame))
        return "; ".join(f"{camera}: {', '.join(names)}" for camera, names in frames.items())

    def frames(self, step: int) -> list[int]:
        """Every `step`-th frame with images, of each take."""
        if not self.sequence.frames:
            raise MissingInput(
                "The training take has no frame with images.", self.sequence.name, "Check the capture."
            )
        return self.sequence.every(step)

    def view(
        self, frame: int, camera: str, scale: float = 1.0, random_crop: RandomCrop | None = None
    ) -> View:
        """One view at `scale` times its resolution, or a crop of it."""
        return self.prefetcher.value((frame, camera, scale, random_crop))

    def _make(self, key: ViewKey) -> View:
        frame, camera, scale, random_crop = key
        crop = self._crop(frame, camera)
        view_camera = crop.camera if scale == 1.0 else crop.camera.scaled(scale)
        size = (view_camera.width, view_camera.height)
        image: NDArray[Any] = crop.image
        layer: NDArray[Any] = crop.layer
        silhouette: NDArray[Any] = crop.silhouette.astype(np.float32)
        inside = crop.mask > MASK_THRESHOLD
        if scale != 1.0:
            image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
            silhouette = cv2.resize(silhouette, size, interpolation=cv2.INTER_AREA)
            inside = cv2.resize(crop.mask, size, interpolation=cv2.INTER_AREA) > MASK_THRESHOLD
            layer = cv2.resize(layer, size, interpolation=cv2.INTER_NEAREST)
        valid = _edge(inside) == 0
        if random_crop is not None:
            box = left, top, right, bottom = random_crop.box(layer, _BACKGROUND)
            view_camera, part = view_camera.crop(box), (slice(top, bottom), slice(left, right))
            image, layer, silhouette, inside, valid = (
                a[part] for a in (image, layer, silhouette, inside, valid)
            )
        labels = np.stack([layer == index for index in range(len(self.layers))], axis=2)
        return View(
            camera=view_camera,
            frame=frame,
            image=torch.from_numpy(image.astype(np.float32) / 255.0),
            inside=torch.from_numpy(inside.astype(np.float32)),
            valid=torch.from_numpy(valid.astype(np.float32)),
            labels=torch.from_numpy(labels.astype(np.float32)),
            known=torch.from_numpy((valid & (layer != _UNKNOWN)).astype(np.float32)),
            silhouette=torch.from_numpy(np.ascontiguousarray(silhouette)),
        )

    def _crop(self, frame: int, camera: str) -> _Crop:
        with self._cache_lock:
            return self._cached_crop((frame, camera))

    def _cached_crop(self, key: tuple[int, str]) -> _Crop:
        crop = self._crops.get(key)
        if crop is not None:
            self._crops.move_to_end(key)
            return crop
        crop = self._read(*key)
        self._crops[key] = crop
        self._cached_bytes += crop.bytes
        while self._cached_bytes > self.cache_bytes and len(self._crops) > 1:
            _, dropped = self._crops.popitem(last=False)
            self._cached_bytes -= dropped.bytes
        return crop

    def _read(self, frame: int, camera: str) -> _Crop:
        whole = self.sequence.camera(camera, frame)
        mask = self.sequence.mask(camera, frame)
        box = box_around(mask > MASK_THRESHOLD, self.margin)
        if box is None:
            self._blank.add((camera, frame))
            return _blank_crop(whole)
        left, top, right, bottom = box
        inside = (slice(top, bottom), slice(left, right))
        mask = mask[inside]
        labels = self.sequence.labels(camera, frame)
        view_camera = whole.crop(box)
        layer = np.full(mask.shape, _UNKNOWN, dtype=np.uint8)
        if labels is not None:
            labels = labels[inside]
            layer = self._layer_of_id[labels]
            layer[labels == NO_LABEL] = _UNKNOWN
        layer[mask <= MASK_THRESHOLD] = _BACKGROUND
        silhouette = rasterize_silhouette(self._body_vertices(frame), self.body.faces, view_camera)
        if BODY in self.layers:  # hair and shoes are part of the body, but not of the body model
            silhouette |= layer == self.layers.index(BODY)
        image = self.sequence.image(camera, frame)[inside].copy()
        if camera in self.exposures:
            image = self.exposures[camera].removed(image)
        return _Crop(view_camera, image, mask.copy(), layer, silhouette)

    def _body_vertices(self, frame: int) -> NDArray[np.float32]:
        if frame not in self._posed:
            expression = torch.from_numpy(self.poses.expression[frame])
            vertices = posed_vertices(self.body, *pose_tensors(self.poses, frame), expression).numpy()
            self._posed = {frame: vertices}  # the cameras of a step look at one frame
        return self._posed[frame]


@dataclass(frozen=True)
class _Crop:
    """The cached arrays of a view."""

    camera: Camera
    image: NDArray[np.uint8]
    mask: NDArray[np.uint8]
    layer: NDArray[np.uint8]
    silhouette: NDArray[np.bool_]

    @property
    def bytes(self) -> int:
        return self.image.nbytes + self.mask.nbytes + self.layer.nbytes + self.silhouette.nbytes


def _blank_crop(camera: Camera) -> _Crop:
    """A view that shows nobody: background alone, far outside the image, where nothing is rendered.

    Every picture term is 0 there, so the view teaches nothing.
    """
    left = 20 * camera.width
    shape = (_BLANK_SIDE, _BLANK_SIDE)
    return _Crop(
        camera.crop((left, 0, left + _BLANK_SIDE, _BLANK_SIDE)),
        np.zeros((*shape, 3), np.uint8),
        np.zeros(shape, np.uint8),
        np.full(shape, _BACKGROUND, np.uint8),
        np.zeros(shape, np.bool_),
    )


def _edge(inside: NDArray[np.bool_]) -> NDArray[Any]:
    """1 on the boundary of a mask: dilation minus erosion, 3×3."""
    mask = inside.astype(np.uint8)
    kernel = np.ones((3, 3), dtype=np.uint8)
    return cv2.dilate(mask, kernel) - cv2.erode(mask, kernel)


class Prefetcher(Generic[Key, Value]):
    """Makes values before they are needed. Outside of `running` it makes them when they are needed.

    Arguments:
        make: makes the value of a key; called in one other thread.
    """

    def __init__(self, make: Callable[[Key], Value]) -> None:
        self._make = make
        self._thread: ThreadPoolExecutor | None = None
        self._pending: dict[Key, Future[Value]] = {}

    @contextmanager
    def running(self) -> Iterator[None]:
        """The thread lives as long as this block. A nested block uses the thread of the outer one."""
        if self._thread is not None:
            yield
            return
        with ThreadPoolExecutor(1, thread_name_prefix="gw-prefetch") as self._thread:
            try:
                yield
            finally:
                self.schedule(())
                self._thread = None

    def schedule(self, keys: Iterable[Key]) -> None:
        """These keys are needed next, in this order; everything else is dropped."""
        if self._thread is None:
            return
        scheduled = dict.fromkeys(keys)
        for key in [key for key in self._pending if key not in scheduled]:
            self._pending.pop(key).cancel()
        for key in scheduled:
            if key not in self._pending:
                self._pending[key] = self._thread.submit(self._make, key)

    def value(self, key: Key) -> Value:
        """The value of a key; what making it raised is raised here."""
        pending = self._pending.pop(key, None)
        return self._make(key) if pending is None else pending.result()
