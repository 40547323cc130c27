"""Loads photographs with their cameras from a COLMAP folder or one with transforms files."""

from __future__ import annotations

import os
import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from fragprune_plugins.errors import DatasetError, InputError, log, printable
from fragprune_plugins.files.reading import MEBIBYTE
from fragprune_plugins.hosts.photographs import Photographs, Resolution, Similarity
from fragprune_plugins.types import View, one_line
from fragprune_plugins.workbench.scenes import colmap, transforms
from fragprune_plugins.workbench.scenes.images import SUFFIXES, image_size, opened, turned
from fragprune_plugins.workbench.scenes.pinhole import Camera
from fragprune_plugins.workbench.scenes.posed import Lens, Pixels, Posed

_ASPECT_TOLERANCE = 0.01
OFF_CENTRE = 0.5  # pixels
_SEEN = 128  # grey levels of a mask, from which on the photograph is looked at
_SMALLER = ("images_2", "images_4", "images_8")
_LAYOUTS = (
    "sparse/0 with images/ (COLMAP), or transforms_train.json (Blender) or transforms.json "
    "(nerfstudio)"
)

# what is said of photographs that ``turned`` says this of
_TURNED = {
    True: "an EXIF orientation. Their pixels are read as they are stored, as COLMAP and hosts do. "
    "If the program that found the cameras turned them, turn their pixels, too (exiftran -ai)",
    None: "broken EXIF, which may say that they are turned. If they are upright, save them "
    "without it (exiftool -all=)",
}

SomeShot = TypeVar("SomeShot", bound="Shot")


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera, and the picture to be seen from it."""

    target: ClassVar[str] = "photographs"  # what the picture is; "itself" for the model's own

    name: str  # unique in its dataset
    view: View  # with the background colour of its picture

    __repr__ = one_line

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB on the view's device."""
        raise NotImplementedError

    def looked_at(self, image: Tensor) -> Tensor:
        """A picture of this view (3, H, W), black where the target is not to be looked at."""
        return image

    def unkept(self) -> Shot:
        """The same for one look, which takes no room of the pictures that are kept."""
        return self

    def to(self: SomeShot, device: torch.device | str) -> SomeShot:
        """The same with its view on a device; ``self`` if it is there already."""
        if self.view.background.device == torch.device(device):
            return self
        return replace(self, view=self.view.to(device))


ROOM = 4096 * MEBIBYTE  # bytes of pixels that are kept: 170 photographs of 3840x2160 pixels


class PixelSlot:
    """The place of one photograph's pixels, shared by its copies on other devices."""


class Pictures(weakref.WeakKeyDictionary[PixelSlot, Tensor]):
    """Pixels in slots. What came while there was room (bytes) stays; the rest is read at each use:
    views come in random orders, in which pixels that make room would come back too late.
    """

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    @property
    def size(self) -> int:
        """Bytes of all pixels that are kept."""
        return sum(pixels.numel() for pixels in self.values())

    def load(self, slot: PixelSlot, read: Callable[[], Tensor]) -> Tensor:
        """The slot's pixels, read if they are not there."""
        if (known := self.get(slot)) is None:
            known = read()
            if self.size + known.numel() <= self.room:
                self[slot] = known
        return known


PICTURES = Pictures(ROOM)  # of the whole process


@dataclass(frozen=True, eq=False)
class Photograph(Shot):
    """One photograph with its camera; RGB in [0, 1], composited over the view's background.

    The file is read at first use, and kept in main memory at 8 bits a channel as long as there is
    room: a scene's photographs may be larger than any memory.
    """

    path: Path
    camera: Camera | None = None  # of the whole photograph, straightened; None if ``lens`` is
    lens: Lens | None = None  # what bends the photograph; None if it is straight
    mask: Path | None = None  # an image of the same aspect; the photograph is black where this is
    opaque: bool = False  # an alpha channel counts for nothing; the colours stay under it
    _pixels: PixelSlot = field(default_factory=PixelSlot, repr=False)

    __repr__ = one_line

    def read_as(self, centred: bool, opaque: bool) -> Photograph:
        """The same around the middle or its camera's principal point, with or without alpha."""
        slot = self._pixels if opaque == self.opaque else PixelSlot()
        same = replace(self, opaque=opaque, _pixels=slot)
        if self.camera is None:
            return same
        seen, behind = self.camera.resized(self.view.width, self.view.height), self.view.background
        if centred:
            seen = replace(seen, cx=seen.width / 2, cy=seen.height / 2)
        return replace(same, view=seen.view(behind.cpu())).to(behind.device)

    def unkept(self) -> Photograph:
        """The same, whose pixels go with it."""
        return replace(self, _pixels=PixelSlot())

    @property
    def transparent(self) -> bool:
        """Whether the image has an alpha channel; its header is read."""
        with opened(self.path) as file:
            return file.has_transparency_data

    @property
    def image(self) -> Tensor:
        """(3, H, W) RGB in [0, 1] on the view's device."""
        return self._read()[..., :3].permute(2, 0, 1).float() / 255

    def looked_at(self, image: Tensor) -> Tensor:
        """A picture of this view (3, H, W), black where the mask is."""
        return image if self.mask is None else image * (self._read()[..., 3] > 0)

    def _read(self) -> Tensor:
        """(H, W, 3) uint8, or 4 with a mask, on the view's device."""
        return PICTURES.load(self._pixels, self._load).to(self.view.background.device)

    def _load(self) -> Tensor:
        with opened(self.path) as file:
            whole = file.size
            picture = self._fitted(file.convert("RGBA" if file.has_transparency_data else "RGB"))
        if picture.shape[2] == 4 and not self.opaque:
            behind = (*(255 * self.view.background).round().int().tolist(), 255)
            ground = Image.new("RGBA", picture.shape[1::-1], behind)
            picture = np.array(Image.alpha_composite(ground, Image.fromarray(picture)))
        flat = np.ascontiguousarray(picture[..., :3])
        if self.mask is not None:
            with opened(self.mask) as file:
                _expect_aspect(self.mask, file.size, "its photograph", whole)
                levels = self._fitted(file.convert("RGBA").convert("LA"))
            seen = levels.min(axis=2) >= _SEEN  # what is transparent is black
            if not seen.any():
                found = f"a mask that is black everywhere: grey levels end at {levels.min(2).max()}"
                expected = f"some of the photograph to look at, from {_SEEN} on"
                remedy = "Remove the view, or turn the mask over."
                raise DatasetError(str(self.mask), found, expected, remedy)
            shown = seen[..., None].astype(np.uint8)
            flat = np.concatenate([flat * shown, shown], axis=2)
        return torch.from_numpy(flat)

    def _fitted(self, picture: Image.Image) -> Pixels:
        """The pixels of a picture, straightened and of the view's size."""
        if self.lens is not None:
            assert self.camera is not None
            picture = Image.fromarray(self.lens.straighten(np.asarray(picture), self.camera))
        size = (self.view.width, self.view.height)
        return np.array(picture if picture.size == size else picture.resize(size))


@dataclass(frozen=True, eq=False)
class Dataset:
    """Training views, and held-out views for measuring."""

    train: Sequence[Shot]
    test: Sequence[Shot]

    __repr__ = one_line

    @property
    def extent(self) -> float:
        """1.1 times the largest distance of a training camera from their mean, world units.

        Hosts scale the learning rate of positions by this.
        """
        centres = torch.stack([shot.view.campos for shot in self.train])
        return 1.1 * float((centres - centres.mean(0)).norm(dim=1).max()) or 1.0

    @property
    def leaked(self) -> int:
        """How many held-out photographs are training photographs too; 0 of own pictures."""
        train, test = (
            {os.path.realpath(shot.path) for shot in part if isinstance(shot, Photograph)}
            for part in (self.train, self.test)
        )
        return len(train & test)

    @property
    def off_centre(self) -> float:
        """How far a photograph's principal point is off its middle, at most, in its own pixels."""
        cameras = (getattr(shot, "camera", None) for shot in (*self.train, *self.test))
        return max((each.off_centre for each in cameras if each), default=0.0)

    @property
    def transparent(self) -> bool:
        """Whether a training photograph has an alpha channel."""
        return any(shot.transparent for shot in self.train if isinstance(shot, Photograph))

    def read_as(self, centred: bool, opaque: bool) -> Dataset:
        """The same with photographs that are ``read_as`` this."""
        train, test = (
            [s.read_as(centred, opaque) if isinstance(s, Photograph) else s for s in part]
            for part in (self.train, self.test)
        )
        return Dataset(train, test)

    def to(self, device: torch.device | str) -> Dataset:
        """The same photographs with their views on a device."""
        return Dataset([s.to(device) for s in self.train], [s.to(device) for s in self.test])


def shots_of(where: str, given: Any) -> list[Shot]:
    """A list of the photographs that a function was given; InputError if that is something else."""
    shots = list(given) if isinstance(given, Iterable) else [given]
    if wrong := [type(each).__name__ for each in shots if not isinstance(each, Shot)]:
        found = f"a {wrong[0]}" + (f" in a {type(given).__name__}" if given is not shots[0] else "")
        remedy = "Pass those of load_dataset(FOLDER): its .train or .test."
        raise InputError(where, found, "photographs of a data set", remedy)
    return shots


def load_photographs(photographs: Photographs) -> Dataset:
    """Load the photographs of a run with ``load_dataset``; if it holds none out, all train."""
    read = dict(vars(photographs))
    held_out = read.pop("held_out")
    dataset = load_dataset(**read)
    return dataset if held_out else Dataset([*dataset.train, *dataset.test], [])


def load_dataset(
    folder: str | Path,
    *,
    resolution: int | Resolution = 1,
    white_background: bool = False,
    images: str = "images",
    centred: bool | None = None,
    opaque: bool = False,
    world: Similarity | None = None,
) -> Dataset:
    """Read a COLMAP folder (sparse/, images/), or Blender's or nerfstudio's transforms files.

    COLMAP holds out every 8th view of the sorted names, as hosts do. Images whose size differs
    from their camera's are accepted when the aspect agrees to 1 %: intrinsics scale with them.

    Args:
        folder: the scene.
        resolution: a divisor of the images' sides, or a ``Resolution``.
        white_background: composite images with alpha over white instead of black, and render so.
        images: name of the image folder, if it is not ``images`` or not what the transforms say.
            Without ``images/``, the largest of ``images_2``, ``images_4`` and ``images_8`` serves.
        centred: render as if each principal point was the middle of its picture, as 3DGS does. None
            does not, but warns where it makes a difference.
        opaque: drop alpha channels, as 3DGS does of a COLMAP folder's images.
        world: takes the scene's world into that of the models: four rows of four, a similarity.

    Raises:
        DatasetError: the folder has neither layout or both, an image is missing, a camera model is
            unknown, a lens cannot be straightened, or sizes do not match.
    """
    background = torch.full((3,), float(white_background))
    size = resolution if isinstance(resolution, Resolution) else Resolution(divide=resolution)
    rows = [_moved(part, world) for part in read_scene(Path(folder), images)]
    for part in rows:
        (path, views), *_ = Counter(row.image for row in part).most_common(1)
        if views > 1:
            found, expected = f"the photograph of {views} views", "a photograph for each view"
            remedy = "Keep the sub-folders that the scene names below its folder of images."
            raise DatasetError(str(path), found, expected, remedy)
    train, test = ([make_shot(row, background, size, opaque) for row in part] for part in rows)
    dataset = Dataset(train, test)
    dataset = dataset.read_as(True, opaque) if centred else dataset
    straight = all(row.lens is None for part in rows for row in part)
    off = dataset.off_centre if straight and centred is None else 0
    if off > OFF_CENTRE and not transforms.has_transforms(Path(folder)):
        log.warning(
            "%s: the principal point is up to %.1f pixels off the middle, which 3DGS and most of "
            "its descendants ignore: figures of their models are wrong, unless these lie in their "
            "output folder, with cfg_args, or finetune made them",
            *(printable(str(folder)), off),
        )
    _warn_of_turned(row.image for part in rows for row in part)
    if dataset.leaked:
        log.warning(
            "%s: %d of the %d held-out views are training views too, so figures on them flatter: "
            "remove these from one of the two",
            *(printable(str(folder)), dataset.leaked, len(test)),
        )
    return dataset


def _moved(rows: list[Posed], world: Similarity | None) -> list[Posed]:
    """The same, in the world of the models."""
    if world is None:
        return rows
    into = torch.tensor(world, dtype=torch.float64)
    return [row._replace(camera=row.camera.moved(into)) for row in rows]


def _warn_of_turned(images: Iterable[Path]) -> None:
    answers = {image: turned(image) for image in images}
    for answer, said in _TURNED.items():
        if such := [image for image, each in answers.items() if each is answer]:
            some = "%d of the photographs, such as %s, have "
            log.warning(some + said, len(such), printable(str(such[0])))


def read_scene(
    folder: Path, images: str = "images", *, split: bool = True
) -> tuple[list[Posed], list[Posed]]:
    """Read the training and the held-out cameras of a scene, and where their images should be.

    No image is opened, but for the size of one whose transforms file has no ``w`` and ``h``.
    DatasetError as of ``load_dataset``; without ``split``, a single camera is enough.
    """
    if not os.path.isdir(folder):  # False for a name that no folder can have, too
        found, remedy = "no such folder", "Check --data."
        if os.path.isfile(folder):
            found, remedy = "a file", f"Pass {folder.resolve().parent}."
        raise DatasetError(str(folder), found, "a folder with photographs", remedy)
    model = colmap.find_model(folder)
    known = transforms.has_transforms(folder)
    if model is not None and known and model != folder / colmap.NERFSTUDIOS:
        found = "both COLMAP's and a transforms layout"
        raise DatasetError(str(folder), found, _LAYOUTS, "Move one aside.")
    if model is None and not known:
        raise DatasetError(str(folder), "neither layout", _LAYOUTS, _where_else(folder))
    train, test = (transforms if known else colmap).read(folder, _image_folder(folder, images))
    if not (train and test if split else train or test):
        found = f"no {'held-out' if train else 'training'} view ({len(train) + len(test)} in all)"
        expected = "at least one training and one held-out view" if split else "at least one view"
        held = "every 8th is held out, unless the scene lists others by name"
        raise DatasetError(str(folder), found, expected, f"Add photographs; {held}.")
    return train, test


def _where_else(folder: Path) -> str:
    """What to do about a folder that is no scene."""
    inside = sorted(each for each in folder.iterdir() if each.is_dir())
    for other in (folder.resolve().parent, *inside):
        if colmap.find_model(other) is not None or transforms.has_transforms(other):
            return f"Pass {other}."
    if parts := colmap.others(folder):
        return f"Rename {parts[0]} to 0."
    if any(each.suffix.lower() in SUFFIXES for each in folder.iterdir()):
        return "These images have no cameras; run COLMAP on them first."
    return "Pass the folder that contains them."


def _image_folder(folder: Path, images: str) -> str:
    """The image folder asked for; a smaller one in place of an ``images/`` that is not there."""
    if images == "images" and not (folder / images).exists():
        for smaller in _SMALLER:
            if (folder / smaller).is_dir():
                said = printable(str(folder))
                log.warning("%s: no images/; reading the photographs of %s/", said, smaller)
                return smaller
    return images


def make_shot(
    row: Posed, background: Tensor, resolution: Resolution, opaque: bool = False
) -> Photograph:
    """Pair an image file with its camera. This reads only the file's header."""
    width, height = image_size(row.image)
    camera = row.camera
    _expect_aspect(row.image, (width, height), "its camera", (camera.width, camera.height))
    view = camera.resized(*resolution.of(width, height)).view(background)
    return Photograph(row.name, view, row.image, camera, row.lens, row.mask, opaque)


def _expect_aspect(
    path: Path, size: tuple[int, int], whose: str, expected: tuple[int, int]
) -> None:
    """Raise DatasetError if a picture has another aspect than it should."""
    (width, height), (wide, high) = size, expected
    rounded = max(wide, high) if width < wide and height < high else 0  # to a pixel, on the way
    if abs(width * high - height * wide) > max(_ASPECT_TOLERANCE * height * wide, rounded):
        lying = abs(width * wide / (height * high) - 1) <= _ASPECT_TOLERANCE
        remedy = "Turn its pixels as its EXIF orientation says (exiftran -ai). " if lying else ""
        remedy += "Use the images that the cameras were calibrated with."
        fits = f"those of {whose}, {wide}x{high}, or that aspect"
        raise DatasetError(str(path), f"{width}x{height} pixels", fits, remedy)
