"""Log a scene's cameras, photos and points, and a model's renderings, to rerun.

python examples/rerun_scene.py --scene demo --model runs/demo --out scene.rrd
"""

import argparse

import rerun as rr
import torch

import nexwarp as nw


def log_camera(path: str, camera: nw.Camera) -> None:
    """Log a pinhole camera with its pose, x right, y down, z forward."""
    pose = torch.linalg.inv(camera.viewmat.double()).numpy()
    rr.log(path, rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
    size = [camera.width, camera.height]
    rr.log(path, rr.Pinhole(image_from_camera=camera.K.numpy(), resolution=size, camera_xyz=rr.ViewCoordinates.RDF))


def main() -> None:
    """Write a recording; without --out, open rerun's viewer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--model", help="a run or a model, whose renderings of the test views are logged")
    parser.add_argument("--out", help="a .rrd file")
    args = parser.parse_args()
    scene = nw.load_scene(args.scene)
    rr.init("nexwarp", spawn=args.out is None)
    if args.out is not None:
        rr.save(args.out)
    rr.log("world/points", rr.Points3D(scene.points.numpy(), colors=scene.colors.numpy()), static=True)
    model = nw.load(args.model) if args.model else None
    for index, view in enumerate([*scene.train, *scene.test]):
        rr.set_time("view", sequence=index)
        log_camera("world/camera", view.camera)
        rr.log("world/camera/photo", rr.Image(view.image.numpy()))
        if model is not None:
            image = model.render_image(view.camera).clamp(0, 1)
            rr.log("rendering", rr.Image((image * 255).byte().numpy()))


if __name__ == "__main__":
    main()
