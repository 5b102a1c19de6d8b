"""Compile the kernels of the simulated field and of its photographs; see `heliotrope.warm`.

Run ``python -m heliotrope.twin.warm`` once after an installation, after ``heliotrope.warm``; it
takes about three seconds.
"""


def main() -> None:
    """Compile the kernels of the field and of the photographs."""
    moving()
    drawing()


def moving() -> None:
    """Move a field of two heliostats in the same way as a simulated plant's loop."""
    from heliotrope.field.layouts import malan_plant
    from heliotrope.lcu.lease import UNIT
    from heliotrope.links.clock import VirtualClock
    from heliotrope.twin.field.field import TICK_MS, Field
    from heliotrope.twin.live import World, WorldOptions

    world = World(malan_plant(2), VirtualClock(), WorldOptions(rendered=False))
    field = world.field
    assert isinstance(field, Field)
    field.take_sun((0, *(int(UNIT * part) for part in world.sun()), 0, 0, 0))
    field.order("APPROACH")
    field.advance(2 * TICK_MS)
    world.errors()


def drawing() -> None:
    """Render a photograph of one beam in the same way as the process of `drawing.Drawer`."""
    from datetime import UTC, datetime

    from heliotrope import sun
    from heliotrope.field.layouts import malan_plant
    from heliotrope.geometry import bisector, normalize
    from heliotrope.imaging.synthetic.scenes import Scene
    from heliotrope.twin.drawing import Exposure, Optics
    from heliotrope.twin.true_mirrors import TrueMirror

    design, at = malan_plant(2), datetime(2026, 6, 21, 10, tzinfo=UTC)
    light = sun.vector(at, design.site)
    target, vertex = design.targets[0], design.position[0]
    normal = bisector(light, normalize(target.center - vertex))
    camera = next(camera for camera in design.cameras if target.name in camera.targets)
    mirrors = (TrueMirror(design.names[0], vertex, normal),)
    Exposure(Scene(camera, (target,)), mirrors, light, Optics(), 0, "warm", at).draw()


if __name__ == "__main__":
    main()
