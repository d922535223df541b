"""Show a scene's cameras and points, and a model's rendering from where one looks, with viser.

python examples/viser_scene.py --scene demo --model runs/demo
"""

import argparse
import time

import torch
import viser
import viser.transforms as tf

import nexwarp as nw


def show(server: viser.ViserServer, scene: nw.Scene) -> None:
    """Add the points and the training cameras of a scene."""
    server.scene.add_point_cloud("/points", scene.points.numpy(), scene.colors.numpy(), point_size=0.003 * scene.scale)
    for view in scene.train:
        camera, pose = view.camera, torch.linalg.inv(view.camera.viewmat.double()).numpy()
        server.scene.add_camera_frustum(
            f"/cameras/{view.name}",
            fov=2 * float(torch.atan(torch.tensor(0.5 * camera.height / camera.fy))),
            aspect=camera.width / camera.height,
            scale=0.05 * scene.scale,
            image=view.image.numpy()[::4, ::4],
            wxyz=tf.SO3.from_matrix(pose[:3, :3]).wxyz,
            position=pose[:3, 3],
        )


def main() -> None:
    """Serve the scene until Ctrl-C; with a model, its rendering is the background."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene", default="demo")
    parser.add_argument("--model", help="a run or a model; without one, cameras and points alone are shown")
    parser.add_argument("--port", type=int, default=8080)
    parser.add_argument("--seconds", type=float, default=float("inf"))
    args = parser.parse_args()
    scene = nw.load_scene(args.scene)
    server = viser.ViserServer(host="127.0.0.1", port=args.port)
    show(server, scene)
    model = nw.load(args.model).to("cuda" if torch.cuda.is_available() else "cpu") if args.model else None
    end = time.monotonic() + args.seconds
    while time.monotonic() < end:
        time.sleep(0.05)
        if model is None:
            continue
        for client in server.get_clients().values():
            pose = tf.SE3.from_rotation_and_translation(tf.SO3(client.camera.wxyz), client.camera.position)
            focal = 120 / torch.tan(torch.tensor(0.5 * client.camera.fov)).item()
            K = [[focal, 0, 160], [0, focal, 120], [0, 0, 1]]
            image = model.render_image(nw.Camera(pose.inverse().as_matrix(), torch.tensor(K), 320, 240))
            client.scene.set_background_image((image.clamp(0, 1) * 255).byte().cpu().numpy())


if __name__ == "__main__":
    main()
