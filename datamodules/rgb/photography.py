"""Steps of what a camera, its files and a mask do to a picture."""

from dataclasses import dataclass

import cv2
import numpy as np

from datamodules.rgb.chain import ColourStep, Photo


@dataclass(frozen=True, kw_only=True)
class Tone(ColourStep):
    """Exposure, white balance, contrast, gamma and saturation.

    Attributes:
        gain: Standard deviation of the exposure, stops.
        balance: Of each channel's gain, stops.
        contrast: Of the contrast, as a share.
        gamma: Of the gamma, as a share.
        saturation: Of the saturation, as a share.
    """

    gain: float = 0.35
    balance: float = 0.12
    contrast: float = 0.15
    gamma: float = 0.12
    saturation: float = 0.25

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        gain, *balance, contrast, gamma, saturation = strength * rng.standard_normal(7)
        gains = 2 ** (
            (self.gain * gain + self.balance * np.array(balance)) / 2
        )  # of light, whose roots these are
        vivid, contrast = np.exp(self.saturation * saturation), np.exp(self.contrast * contrast)
        mixed = contrast * gains[:, None] * (vivid * np.eye(3) + (1 - vivid) / 3)
        moved = (1 - contrast) * gains * np.array(cv2.mean(photo.rgb)[:3])
        rgb = cv2.transform(photo.rgb, np.concatenate([mixed, moved[:, None]], 1))
        # A camera's files have 8 bits.
        levels = (np.arange(256) / 255) ** np.exp(self.gamma * gamma)
        photo.rgb = cv2.LUT(cv2.convertScaleAbs(np.maximum(rgb, 0), alpha=255), levels.astype(np.float32))


@dataclass(frozen=True, kw_only=True)
class Defocus(ColourStep):
    """The lens is out of focus.

    Attributes:
        sigma: Greatest standard deviation of the blur, as a share of the crop's height.
    """

    sigma: float = 0.012

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        sigma = strength * self.sigma * rng.random() * len(photo.rgb)
        if sigma > 0.1:
            photo.rgb = cv2.GaussianBlur(photo.rgb, (0, 0), sigma)


@dataclass(frozen=True, kw_only=True)
class Motion(ColourStep):
    """The person or the camera moves: a blur along a line.

    Attributes:
        length: Greatest length of the line, as a share of the crop's height.
    """

    length: float = 0.05

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        length, angle = strength * self.length * rng.random() * len(photo.rgb), rng.uniform(0, np.pi)
        if length < 1:
            return
        half = int(np.ceil(length / 2))
        kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
        along = np.array([np.cos(angle), np.sin(angle)]) * length / 2
        start, end = (np.rint((half + sign * along) * 16).astype(int).tolist() for sign in (-1, 1))
        cv2.line(kernel, start, end, 1.0, 1, cv2.LINE_8, 4)  # in sixteenths of pixels
        photo.rgb = cv2.filter2D(photo.rgb, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


@dataclass(frozen=True, kw_only=True)
class LowResolution(ColourStep):
    """The person is small in the image: fewer pixels than the crop has.

    Attributes:
        factor: Greatest factor by which they are fewer, along a side.
    """

    factor: float = 3.0

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        factor = 1 + strength * (self.factor - 1) * rng.random()
        height, width = photo.rgb.shape[:2]
        small = max(2, round(width / factor)), max(2, round(height / factor))
        way = (cv2.INTER_LINEAR, cv2.INTER_CUBIC)[int(rng.integers(2))]
        fewer = cv2.resize(photo.rgb, small, interpolation=cv2.INTER_AREA)
        photo.rgb = np.clip(cv2.resize(fewer, (width, height), interpolation=way), 0, 1)


@dataclass(frozen=True, kw_only=True)
class Noise(ColourStep):
    """Noise of the camera's sensor: shot noise, whose variance grows with the light, and read noise.

    Attributes:
        shot: Greatest standard deviation of the shot noise at full light.
        read: Greatest standard deviation of the read noise.
    """

    shot: float = 0.05
    read: float = 0.02

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        shot, read = strength * np.array([self.shot, self.read]) * rng.random(2)
        noise = rng.standard_normal(photo.rgb.shape, dtype=np.float32)
        noise *= np.sqrt(np.float32(shot**2) * photo.rgb + np.float32(read**2))
        photo.rgb = np.clip(photo.rgb + noise, 0, 1)


@dataclass(frozen=True, kw_only=True)
class Jpeg(ColourStep):
    """What JPEG does to a picture.

    Attributes:
        quality: Range of its quality, percent.
    """

    quality: tuple[float, float] = (30, 95)

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        quality = int(np.clip(100 - strength * (100 - rng.uniform(*self.quality)), 5, 100))
        picture = cv2.convertScaleAbs(photo.rgb, alpha=255)
        code = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        read = np.asarray(cv2.imdecode(code, cv2.IMREAD_COLOR))[..., ::-1]
        photo.rgb = read.astype(np.float32) / 255


@dataclass(frozen=True, kw_only=True)
class MaskErrors(ColourStep):
    """A mask with a rim of the background, with an eaten border, with holes and with spots of the background.

    Attributes:
        rim: Greatest width of the rim, or of what is eaten, as a share of the crop's height.
        ragged: How uneven the border is, as a share of that width.
        holes: Greatest number of holes, and of spots of the background, anywhere in the crop.
        size: Range of their radius, as a share of the crop's height.
    """

    rim: float = 0.012
    ragged: float = 1.0
    holes: float = 2
    size: tuple[float, float] = (0.01, 0.04)

    def photograph(self, photo: Photo, rng: np.random.Generator, strength: float) -> None:
        """See `ColourStep`."""
        mask, (height, width) = photo.mask, photo.mask.shape
        shift = strength * self.rim * height * rng.uniform(-1, 1)
        inside = cv2.distanceTransform(mask, cv2.DIST_L2, 3)
        outside = cv2.distanceTransform(1 - mask, cv2.DIST_L2, 3)
        coarse = rng.random((height // 16 + 1, width // 16 + 1), dtype=np.float32)
        uneven = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC) - 0.5
        moved = ((inside - outside) + shift * (1 + 2 * self.ragged * uneven) > 0).astype(np.uint8)
        for value in (0, 1):
            for _ in range(int(rng.integers(0, int(self.holes) + 1))):
                centre = rng.random(2) * (width, height)
                radii = np.maximum(strength * height * rng.uniform(*self.size, 2), 1)
                centre, axes = (np.rint(numbers).astype(int).tolist() for numbers in (centre, radii))
                cv2.ellipse(moved, centre, axes, rng.uniform(0, 180), 0, 360, value, -1)
        if moved.any():
            photo.mask = moved
