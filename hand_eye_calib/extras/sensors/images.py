"""Read the poses of a camera from a bag with its images of a target."""

from pathlib import PurePosixPath

from hand_eye_calib.core.base.errors import InputError, located, printable
from hand_eye_calib.core.base.text import frame_name
from hand_eye_calib.core.geometry import se3
from hand_eye_calib.extras.sensors.cameras import Camera, camera_of, read_camera
from hand_eye_calib.extras.sensors.target_images import (
    Target,
    TargetFinder,
    grey_of,
)
from hand_eye_calib.formats.bags import messages
from hand_eye_calib.formats.bags.pose_table import PoseTable
from hand_eye_calib.formats.bags.reader import PoseBag
from hand_eye_calib.formats.bags.sources import Reading


def read_images(
    bag: PoseBag, stream: str, topic: str, text: str
) -> "ImageReading":
    """Return the reader of images of a target.

    The intrinsics come from a file, or from a camera_info topic: that in the namespace of the
    images, or in a namespace above it.

    Parameters
    ----------
    bag : PoseBag
    stream : str
        "parent" or "child".
    topic : str
    text : str
        The target, and the file of the intrinsics after ``@`` if there is one.

    Raises
    ------
    InputError
        If the messages are no images, or no intrinsics are found.
    """
    name, _, file = text.partition("@")
    target = Target.parse(name)
    type_ = bag.type_of(topic)
    if type_ not in messages.IMAGE_TYPES:
        raise InputError(f"{topic} has type {type_}, which contains no images")
    if file:
        return ImageReading(stream, topic, target, read_camera(file))
    candidates = [
        str(namespace / "camera_info")
        for namespace in PurePosixPath(topic).parents
    ]
    info = next(
        (candidate for candidate in candidates if candidate in bag.topics), ""
    )
    run = next(bag.runs([info]), None)
    if run is None:
        raise InputError(
            f"no camera_info beside {topic} in {bag}; set a file of the "
            f"intrinsics with --camera, or {topic}?{name}@FILE"
        )
    camera = camera_of(next(run.decoded()), "image_rect" in topic, info)
    return ImageReading(stream, topic, target, camera)


class ImageReading(Reading):
    """Read images of a target as poses of the camera in the frame of the target.

    Images without the target are skipped.
    """

    def __init__(
        self, stream: str, topic: str, target: Target, camera: Camera
    ) -> None:
        super().__init__(stream, topic)
        self._finder = TargetFinder(target, camera)
        self._frame = ""
        self._stamps_ns = list[int]()
        self._bag_ns = list[int]()

    def take(self, run: messages.Run) -> None:
        for message, bag_ns in zip(
            run.decoded(), run.bag_ns.tolist(), strict=True
        ):
            with located(self.name):
                is_usable = self._finder.look(grey_of(message))
            if is_usable:
                self._stamps_ns.append(
                    messages.ns_of(message.header.stamp) or 0
                )
                self._bag_ns.append(bag_ns)
                self._frame = printable(frame_name(message.header.frame_id))

    def table(self) -> PoseTable:
        target_poses = self._finder.found()
        self.notes.append(f"{self.name}: {target_poses}")
        poses = se3.to_rows(se3.inverse(target_poses.Ts_camera_target))
        table = PoseTable.of(self._stamps_ns, poses, "target", self._frame)
        return self._stamped(table.recorded(self.stream, self._bag_ns))
