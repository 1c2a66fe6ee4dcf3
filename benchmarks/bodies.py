"""The figures of docs/synthesis.md: joint positions, drawn people, and cost and appearance of clothes and props.

python benchmarks/bodies.py [--people 4000] [--sheet docs/images/props.png]

joints        of the mean adult in the T-pose: height above the soles, position to the left and in front of the
              pelvis, and the distance to the skin, cm
people        mean and standard deviation of stature, percentiles of BMI and age, by sex and for children
costs         microseconds per person, one core, best of a few rounds
things        how often each prop is drawn with the default mix of poses
"""

import argparse
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from lidarpose.body.rig import clothing, load_rig, sample_people
from lidarpose.skeleton import BODY26
from lidarpose.synth.bodies import Bodies, draw_bodies
from lidarpose.synth.props import Prop, draw_props

BLOCK = 64
ON_SHEET = (
    "bag", "shoulder bag", "rucksack", "phone", "ball", "box", "stick", "umbrella", "suitcase", "hat", "skirt", "skirt",
    "pram", "trolley", "chair", "wheelchair", "bicycle", "skirt",
)  # fmt: skip
PER_ROW = 6
SKIN, THING, CLOTH = (0.70, 0.75, 0.90), (0.93, 0.50, 0.30), (0.45, 0.62, 0.45)


def print_joints() -> None:
    rig = load_rig()
    mean = rig.rest(rig.coefficients[rig.age >= 18].mean(0, keepdims=True))
    vertices, joints, floor = mean.vertices[0], mean.joints[0], mean.vertices[0, :, 2].min()
    print(f"mean adult, {100 * np.ptp(vertices[:, 2]):.1f} cm\njoint             height   left  ahead   skin")
    for name, joint in zip(BODY26.joints, joints, strict=True):
        skin = np.linalg.norm(vertices - joint, axis=1).min()
        print(
            f"{name:15s} {100 * (joint[2] - floor):8.1f} {100 * joint[1]:6.1f} {100 * joint[0]:6.1f} {100 * skin:6.1f}"
        )


def print_people(count: int) -> None:
    people = sample_people(np.random.default_rng(0), count)
    groups = {sex: (people.sex == sex) & (people.age >= 18) for sex in ("male", "female")}
    groups["child"] = people.age < 18
    print(f"\n{count} people\ngroup    share   stature m        BMI 5/50/95        age 5/50/95, oldest")
    for name, mask in groups.items():
        bmi, age = (np.percentile(value[mask], (5, 50, 95)) for value in (people.bmi, people.age))
        print(
            f"{name:8s} {mask.mean():5.2f}   {people.height[mask].mean():.3f} +- {people.height[mask].std():.3f}"
            f"   {bmi[0]:.1f} {bmi[1]:.1f} {bmi[2]:.1f}   {age[0]:.0f} {age[1]:.0f} {age[2]:.0f}, "
            f"{people.age[mask].max():.0f}"
        )


def best(work: Callable[[], object], rounds: int = 5) -> float:
    """Seconds of the fastest of `rounds` rounds."""
    work()
    times = []
    for _ in range(rounds):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return min(times)


def print_costs(bodies: Bodies) -> None:
    rng, rig, count = np.random.default_rng(0), load_rig(), len(bodies.kinds)

    def props() -> None:
        for row, kind in enumerate(bodies.kinds):
            for prop in draw_props(rng, kind=kind, joints=bodies.joints[row]):
                prop.place(bodies.joints[row])

    print("\ncosts, us a person")
    print(f"shapes          {best(lambda: sample_people(rng, BLOCK)) / BLOCK * 1e6:6.1f}")
    print(f"clothing        {best(lambda: clothing(rng, BLOCK)) / BLOCK * 1e6:6.1f}")
    print(f"props and place {best(props) / count * 1e6:6.1f}")
    thickness = clothing(rng, 400)
    torso = rig.dense_weight[:, [BODY26.index(n) for n in ("pelvis", "spine1", "spine2", "spine3")]].sum(1) > 0.9
    low, middle, high = 100 * np.percentile(thickness[:, torso].mean(1), (5, 50, 95))
    print(f"clothes on the torso, mean of a person, 5/50/95: {low:.1f} {middle:.1f} {high:.1f} cm")


def drawn(bodies: Bodies, rounds: int) -> dict[str, list[tuple[list[Prop], int]]]:
    """name of a prop -> all props of each person who has it, and the person's row."""
    rng = np.random.default_rng(0)
    entries_by_name: dict[str, list[tuple[list[Prop], int]]] = {}
    for _ in range(rounds):
        for row, kind in enumerate(bodies.kinds):
            props = draw_props(rng, kind=kind, joints=bodies.joints[row])
            for prop in props:
                entries_by_name.setdefault(prop.name, []).append((props, row))
    return entries_by_name


def print_things(bodies: Bodies) -> None:
    rounds = 5
    entries_by_name = drawn(bodies, rounds)
    counts = Counter({name: len(rows) for name, rows in entries_by_name.items()})
    print("\nthings, share of people, and faces")
    for name, count in counts.most_common():
        faces = [len(p.mesh.faces) for props, _ in entries_by_name[name] for p in props if p.name == name]
        print(f"{name:14s} {count / rounds / len(bodies.kinds):6.3f}   {min(faces)}-{max(faces)}")


def draw_sheet(bodies: Bodies, path: Path) -> None:
    """Draws people with each of the props, seen from the front right."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    entries_by_name = drawn(bodies, 8)
    rows = -(-len(ON_SHEET) // PER_ROW)
    figure = Figure(figsize=(2.0 * PER_ROW, 2.2 * rows), dpi=64)
    canvas, use_counts = FigureCanvasAgg(figure), Counter()
    for place, name in enumerate(ON_SHEET):
        entries = [entry for entry in entries_by_name[name] if len(entry[0]) == 1] or entries_by_name[name]
        props, row = entries[(3 * use_counts[name]) % len(entries)]
        use_counts[name] += 1
        meshes = [(bodies.vertices[row], bodies.faces, SKIN)]
        for prop in props:
            mesh = prop.place(bodies.joints[row])
            meshes.append((mesh.vertices, mesh.faces, THING if prop.face_part is None else CLOTH))
        triangles = np.concatenate([v[f] for v, f, _ in meshes]) + [0, 0, max(p.lift for p in props)]
        colors = np.concatenate([shaded(v[f], color) for v, f, color in meshes])
        axes = figure.add_subplot(rows, PER_ROW, 1 + place, projection="3d")
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=colors))
        x, y = bodies.vertices[row][:, :2].mean(0)
        # leaves space for a trolley in front and an umbrella above
        axes.set(xlim=(x - 0.6, x + 1.3), ylim=(y - 0.95, y + 0.95), zlim=(0, 2.2))
        axes.set_box_aspect((1.9, 1.9, 2.2), zoom=1.3)
        axes.view_init(12, -60)
        axes.set_axis_off()
        axes.set_title(name, fontsize=9, y=0.98)
    figure.subplots_adjust(0, 0, 1, 0.97, 0, 0.02)
    canvas.print_png(str(path))


def shaded(triangles: np.ndarray, color: tuple[float, float, float]) -> np.ndarray:
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-12
    light = 0.4 + 0.6 * np.abs(normal @ [0.5, -0.7, 0.5])
    return np.clip(light[:, None] * np.array(color), 0, 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=4000)
    parser.add_argument("--sheet", type=Path)
    options = parser.parse_args()
    print_joints()
    print_people(options.people)
    bodies = draw_bodies(None, 0.0, 1200, 4, 0, moving=False)
    print_costs(bodies)
    print_things(bodies)
    if options.sheet:
        draw_sheet(bodies, options.sheet)


if __name__ == "__main__":
    main()
