"""Layouts: which files of an exported data set hold what, as people's training code expects them.

Before: nothing.  After: export.py.
Symbols in the paths: split; clip and frame within the clip, from 0, clip1 and frame1 from 1; number of the frame in the
whole data set, from 0; flow the suffix of flow files.

Contents:
- `sharp`, `blur`: 8-bit pictures on the sRGB curve, the bytes of the data set's own PNGs;
- `sharp_gamma`, `blur_gamma`: 8-bit pictures of the linear images to the power 1/2.2; where a camera took the data
  set's PNGs, these;
- `flow_next`, `flow_previous`: motion to the neighbour frame's sharp instant, only where the clip has that frame;
- `flow_exposure`: motion from the shutter's opening to its closing.

Source: the layouts of GoPro (Nah et al. 2017), REDS (Nah et al. 2019), MPI Sintel, Spring, and BasicSR's documentation.
"""

from __future__ import annotations

from dataclasses import dataclass

PICTURES = ("sharp", "blur")
CODED = ("sharp_gamma", "blur_gamma")
FLOWS = {"flow_next": "motion_next", "flow_previous": "motion_previous", "flow_exposure": "motion"}


@dataclass(frozen=True)
class Layout:
    """Where each content of a frame goes; one content may go to several places."""

    split: str  # the usual name of the part to train on
    files: tuple[tuple[str, str], ...] = ()  # (content, path with the symbols above)
    stores: tuple[tuple[str, str], ...] = ()  # (content, LMDB folder); keys are the frames' numbers
    list_path: str = ""  # of BasicSR's meta info
    list_of: str = ""  # what its lines stand for: frame or clip
    flow_suffix: str = ""  # of flow files unless told otherwise; empty without flow
    flow_scale: int = 1  # pixels of flow files a pixel of the picture, in each direction

    @property
    def has_flow(self) -> bool:
        """Whether flow files belong to it."""
        return bool(self.flow_suffix)


LAYOUTS: dict[str, Layout] = {
    "gopro": Layout(
        "train",
        (
            ("sharp_gamma", "{split}/clip{clip:06d}/sharp/{frame:06d}.png"),
            # GoPro's own `blur` is the mean of coded values. Here light is averaged, so both folders hold one picture.
            ("blur_gamma", "{split}/clip{clip:06d}/blur_gamma/{frame:06d}.png"),
            ("blur_gamma", "{split}/clip{clip:06d}/blur/{frame:06d}.png"),
        ),
    ),
    "reds": Layout(
        "train",
        (
            ("sharp", "{split}/{split}_sharp/{clip:03d}/{frame:08d}.png"),
            ("blur", "{split}/{split}_blur/{clip:03d}/{frame:08d}.png"),
        ),
        list_path="{split}/meta_info_REDS_GT.txt",
        list_of="clip",
    ),
    "sintel": Layout(
        "training",
        (
            ("sharp", "{split}/clean/clip_{clip:04d}/frame_{frame1:04d}.png"),
            ("blur", "{split}/final/clip_{clip:04d}/frame_{frame1:04d}.png"),
            ("flow_next", "{split}/flow/clip_{clip:04d}/frame_{frame1:04d}{flow}"),
            ("flow_exposure", "{split}/flow_exposure/clip_{clip:04d}/frame_{frame1:04d}{flow}"),
        ),
        flow_suffix=".flo",
    ),
    "spring": Layout(
        "train",
        (
            ("sharp", "{split}/{clip1:04d}/frame_left/frame_left_{frame1:04d}.png"),
            ("blur", "{split}/{clip1:04d}/blur_left/blur_left_{frame1:04d}.png"),
            ("flow_next", "{split}/{clip1:04d}/flow_FW_left/flow_FW_left_{frame1:04d}{flow}"),
            ("flow_previous", "{split}/{clip1:04d}/flow_BW_left/flow_BW_left_{frame1:04d}{flow}"),
            ("flow_exposure", "{split}/{clip1:04d}/flow_exposure_left/flow_exposure_left_{frame1:04d}{flow}"),
        ),
        flow_suffix=".flo5",
        flow_scale=2,  # Spring's readers take every second value of every second row
    ),
    "basicsr": Layout(
        "train",
        (("sharp", "{split}/gt/{number:08d}.png"), ("blur", "{split}/lq/{number:08d}.png")),
        list_path="{split}/meta_info.txt",
        list_of="frame",
    ),
    "lmdb": Layout("train", stores=(("sharp", "{split}/gt.lmdb"), ("blur", "{split}/lq.lmdb"))),
}


def place_of(path: str, split: str, entry: dict[str, int], flow: str = "") -> str:
    """Return a path of a layout for one frame.

    Args:
        path: with symbols.
        split: name of the part.
        entry: `index`, `clip` and `frame`, as in the manifest.
        flow: suffix of flow files.

    Source: ours.
    """
    clip, frame = entry["clip"], entry["frame"]
    return path.format(
        split=split, clip=clip, clip1=clip + 1, frame=frame, frame1=frame + 1, number=entry["index"], flow=flow
    )
