"""Write the files of a scene from a pycolmap reconstruction."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from nexwarp.data.lens import pycolmap_module

if TYPE_CHECKING:
    import pycolmap


def tracked_only(model: "pycolmap.Reconstruction") -> "pycolmap.Reconstruction":
    """Copy a reconstruction without the features that belong to no point, which are nine tenths of its size.

    Image and point ids, poses, cameras, colours and errors are kept.
    """
    pycolmap = pycolmap_module()
    kept = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        kept.add_camera_with_trivial_rig(camera)
    index_in_kept: dict[tuple[int, int], int] = {}
    for image_id in sorted(model.reg_image_ids()):
        image = model.image(image_id)
        tracked = image.get_observation_point2D_idxs()
        index_in_kept |= {(image_id, old): new for new, old in enumerate(tracked)}
        keypoints = np.array([image.point2D(index).xy for index in tracked]).reshape(-1, 2)
        copy = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=image.camera_id, image_id=image_id)
        kept.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point_id, point in sorted(model.points3D.items()):
        track = pycolmap.Track()
        for element in point.track.elements:
            index = index_in_kept[element.image_id, element.point2D_idx]
            track.add_element(element.image_id, index)
            kept.image(element.image_id).set_point3D_for_point2D(index, point_id)
        copied = pycolmap.Point3D(xyz=point.xyz, color=point.color, error=point.error, track=track)
        kept.add_point3D_with_id(point_id, copied)
    return kept


def move_scene(undistorted: Path, scene: Path) -> list[tuple[int, int]]:
    """Move the output of pycolmap's undistortion into a scene folder: images/, and sparse/0 with tracked features only.

    Args:
        undistorted: folder that `pycolmap.undistort_images` wrote.
        scene: folder of the scene; must not exist.

    Returns:
        The distinct (width, height) of the photos, ascending.
    """
    scene.mkdir()
    (undistorted / "images").rename(scene / "images")
    folder = scene / "sparse" / "0"
    folder.mkdir(parents=True)
    model = tracked_only(pycolmap_module().Reconstruction(str(undistorted / "sparse")))
    model.write_binary(str(folder))
    return sorted({(camera.width, camera.height) for camera in model.cameras.values()})
