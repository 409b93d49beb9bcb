#!/usr/bin/env python3
"""The same cloth in goniofit and in Mitsuba 3: equal means, and CPU seconds to equal error. See README.md beside this file."""

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[3]
HERE = Path(__file__).resolve().parent
LIGHT_SIDE, LIGHT_DISTANCE = 100.0, 610.0  # millimeters: Khungurn 2015
ETA = 1.55
# Scene units per millimeter in Mitsuba. Its rays start (1 + largest coordinate) * 8.9e-5 units off the surface: 0.13 um in
# millimeters, 0.04 um in micrometers, on fibers of 8 um.
UNIT = 1000.0
# Cloth around the central tile, millimeters: with 1 mm the small weave lost 1 % of its light at the edges.
MARGIN = 3.0


def arguments():
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--fabric", type=Path, default=HERE / "small_plain.toml")
    p.add_argument("--params", type=Path, default=HERE / "params.json", help="parameters of model chiang (JSON)")
    p.add_argument("--plan", type=Path, default=HERE / "plan.toml", help="configurations (TOML)")
    p.add_argument("--seconds", type=float, default=30.0, help="CPU seconds per configuration and renderer")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--goniofit", type=Path, default=ROOT / "target/release/goniofit")
    p.add_argument("--variant", default="llvm_ad_rgb", help="a JIT variant")
    p.add_argument("--depth", type=int, default=-1, help="Mitsuba's max_depth; -1 is unlimited")
    p.add_argument("--roulette", type=int, default=1_000_000, help="Mitsuba's rr_depth")
    p.add_argument("--copies", type=int, help="tiles around the central one on every side; default: 3 mm of them")
    p.add_argument("--configs", type=int, nargs="*", help="only these configurations of the plan")
    p.add_argument("--json", action="store_true", help="one JSON object per line instead of a table")
    p.add_argument("--rays", action="store_true", help="measure ray throughput only, beside benches/ray_speed.rs")
    return p.parse_args()


# ---- the scene's description ----------------------------------------------------------------------------------------


def direction(theta_deg, phi_deg):
    t, p = math.radians(theta_deg), math.radians(phi_deg)
    return np.array([math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)])


def poses(plan, wanted):
    """Directions toward light and camera in the sample's frame."""
    for c in tomllib.loads(plan.read_text())["configurations"]:
        if not wanted or c["config"] in wanted:
            turn = c["rotation_deg"]
            light = (c["light_theta_deg"], c["light_phi_deg"] - turn)
            yield c, light, direction(c["camera_theta_deg"], c["camera_phi_deg"] - turn)


def load_curves(goniofit, fabric, folder):
    """Tile size and curves (points n x 3, radius) of a fabric."""
    def export(form, name):
        out = folder / name
        command = [goniofit, "fabric", "export", fabric, "--format", form, "--out", out]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        return out

    with export("csv", "segments.csv").open() as f:
        size = next(json.loads(line.split("=")[1]) for line in f if line.startswith("# tile_mm"))
    blocks = export("mitsuba", "tile.txt").read_text().split("\n\n")
    tables = [np.array([line.split() for line in b.splitlines()], float) for b in blocks if b.strip()]
    return np.array(size), [(t[:, :3], t[0, 3]) for t in tables]


def replicate(size, curves, copies):
    """Curves of (2 copies + 1)^2 tiles, centered, joined over the seams: separate pieces would show their round ends inside the
    fibers."""
    key = lambda p: tuple(np.round(np.append(np.mod(p[:2] + 1e-6, size), p[2]), 5))
    starts = {key(points[0]): i for i, (points, _) in enumerate(curves)}
    if len(starts) != len(curves):
        sys.exit("two fibers of this fabric begin at one point: cannot join them over the seams")
    follower = []
    for points, _ in curves:
        j = starts.get(key(points[-1]))
        step = (0, 0) if j is None else tuple(np.round((points[-1] - curves[j][0][0])[:2] / size).astype(int))
        follower.append((j, step))
    cells = range(-copies, copies + 1)
    inside = lambda cell: cell[0] in cells and cell[1] in cells
    preceded = {
        (j, (x + s[0], y + s[1])) for (j, s) in follower if j is not None for x in cells for y in cells
    }
    joined = []
    for i in range(len(curves)):
        for cell in ((x, y) for x in cells for y in cells):
            if (i, cell) in preceded:
                continue
            at, where, parts = i, cell, []
            while at is not None and inside(where):
                move = np.append(np.array(where) * size - size / 2, 0.0)
                points = curves[at][0] + move
                parts.append(points if not parts else points[1:])
                at, step = follower[at]
                where = (where[0] + step[0], where[1] + step[1])
            joined.append((np.concatenate(parts), curves[i][1]))
    return joined


def write_curves(curves, path):
    with path.open("w") as f:
        for points, radius in curves:
            np.savetxt(f, UNIT * np.column_stack([points, np.full(len(points), radius)]), fmt="%.9g")
            f.write("\n")


def absorption(params):
    b = params["beta_n"]
    g = 5.969 - 0.215 * b + 2.532 * b**2 - 10.73 * b**3 + 5.574 * b**4 + 0.245 * b**5
    return [(math.log(c) / g) ** 2 for c in params["color"]]


def normal_irradiance():
    """On a plane facing the light, per unit radiance: four quarters of a square's form factor."""
    x = 0.5 * LIGHT_SIDE / LIGHT_DISTANCE
    r = math.sqrt(1 + x * x)
    return 4 * (x / r) * math.atan(x / r)


# ---- Mitsuba --------------------------------------------------------------------------------------------------------


def cpu_seconds():
    u = resource.getrusage(resource.RUSAGE_SELF)
    return u.ru_utime + u.ru_stime


def along_fibers(mi, tangents, beta_m):
    """A BSDF plugin around `hair` that mends two faults of release 3.9.1. JIT variants only: in Python, but compiled with the
    rest.

    - `hair` relies on a shading frame whose second axis lies along the fiber, but `linearcurve` leaves an arbitrary one
      (`bsplinecurve` does not). At a joint's sphere the normal is taken perpendicular to the segment, as goniofit does.
    - `hair` samples its fourth lobe (all paths after TRT) with zero for both the sine and the cosine of theta_i, hence always
      straight across the fiber, while its density is the right one: `sample` disagrees with `eval` and `pdf`."""
    import drjit as dr

    variance = 4 * (0.726 * beta_m + 0.812 * beta_m**2 + 3.7 * beta_m**20) ** 2
    table = mi.Float(tangents.astype(np.float32).ravel())

    class AlongFibers(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.inner = props["inner"]
            self.m_components = [self.inner.flags(i) for i in range(self.inner.component_count())]
            self.m_flags = self.inner.flags()

        def turned(self, si):
            axis = dr.gather(mi.Vector3f, table, si.prim_index)
            normal = dr.normalize(si.n - axis * dr.dot(si.n, axis))
            copy = mi.SurfaceInteraction3f(si)
            copy.sh_frame = mi.Frame3f(dr.cross(axis, normal), axis, normal)
            copy.wi = copy.to_local(si.to_world(si.wi))
            return copy

        def sample(self, ctx, si, sample1, sample2, active=True):
            t = self.turned(si)
            bs, _ = self.inner.sample(ctx, t, sample1, sample2, active)
            # Exactly zero in the fourth lobe, whose azimuth is right and for whose angle along the fiber both numbers are free.
            wo = dr.select(bs.wo.y == 0, self.fourth(t.wi, bs.wo, sample2), bs.wo)
            value, pdf = self.inner.eval_pdf(ctx, t, wo, active)
            bs.pdf = pdf
            bs.wo = si.to_local(t.to_world(wo))
            return bs, dr.select(pdf > 0, value / pdf, 0)

        def fourth(self, wi, across, u):
            """The direction of azimuth `across` whose longitudinal angle is sampled as in the first three lobes."""
            c = 1 + variance * dr.log(u.x + (1 - u.x) * math.exp(-2 / variance))
            sin_i, cos_i = wi.y, dr.safe_sqrt(1 - wi.y * wi.y)
            sin_o = dr.safe_sqrt(1 - c * c) * dr.cos(2 * math.pi * u.y) * cos_i - c * sin_i
            cos_o = dr.safe_sqrt(1 - sin_o * sin_o)
            return mi.Vector3f(cos_o * across.x, sin_o, cos_o * across.z)

        def eval(self, ctx, si, wo, active=True):
            t = self.turned(si)
            return self.inner.eval(ctx, t, t.to_local(si.to_world(wo)), active)

        def pdf(self, ctx, si, wo, active=True):
            t = self.turned(si)
            return self.inner.pdf(ctx, t, t.to_local(si.to_world(wo)), active)

        def eval_pdf(self, ctx, si, wo, active=True):
            t = self.turned(si)
            return self.inner.eval_pdf(ctx, t, t.to_local(si.to_world(wo)), active)

        def to_string(self):
            return "AlongFibers[]"

    mi.register_bsdf("along_fibers", lambda props: AlongFibers(props))


class Mitsuba:
    def __init__(self, a, size, path, params, curves):
        import drjit as dr
        import mitsuba as mi

        mi.set_variant(a.variant)
        dr.set_thread_count(1)
        self.mi, self.a, self.size = mi, a, size
        steps = np.concatenate([np.diff(points, axis=0) for points, _ in curves])
        along_fibers(mi, steps / np.linalg.norm(steps, axis=1)[:, None], params["beta_m"])
        self.curves = mi.load_dict(
            {
                "type": "linearcurve",
                "filename": str(path),
                "bsdf": {
                    "type": "along_fibers",
                    "inner": {
                    "type": "hair",
                    "sigma_a": {"type": "rgb", "value": absorption(params)},
                    "longitudinal_roughness": params["beta_m"],
                    "azimuthal_roughness": params["beta_n"],
                    "scale_tilt": 0.0,
                    "int_ior": ETA,
                    "ext_ior": 1.0,
                    },
                },
            }
        )

    def scene(self, light, camera):
        mi = self.mi
        theta, phi = map(math.radians, light)
        center = direction(*light) * LIGHT_DISTANCE * UNIT
        up = [-math.cos(theta) * math.cos(phi), -math.cos(theta) * math.sin(phi), math.sin(theta)]
        transform = mi.ScalarTransform4f
        lamp = transform().look_at(origin=list(center), target=[0, 0, 0], up=up).scale(0.5 * LIGHT_SIDE * UNIT)
        # Parallel rays through the central tile's square in the plane z = 0: a sheared view.
        view = np.eye(4)
        view[:3, 0] = [self.size[0] / 2 * UNIT, 0, 0]
        view[:3, 1] = [0, self.size[1] / 2 * UNIT, 0]
        view[:3, 2] = -camera * UNIT
        view[:3, 3] = camera * 20.0 * UNIT
        film = {"type": "hdrfilm", "width": 64, "height": 64, "rfilter": {"type": "box"}, "pixel_format": "rgb",
                "component_format": "float32", "sample_border": False}
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path", "max_depth": self.a.depth, "rr_depth": self.a.roulette},
                "sensor": {
                    "type": "orthographic",
                    "far_clip": 1000.0 * UNIT,
                    "to_world": transform(view),
                    "film": film,
                    "sampler": {"type": "independent", "sample_count": 16},
                },
                "lamp": {
                    "type": "rectangle",
                    "to_world": lamp,
                    "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
                },
                "cloth": self.curves,
            }
        )

    def means(self, light, camera, seconds, spp=16):
        """Mean, standard error, CPU seconds and paths of at least 16 independent renders."""
        scene = self.scene(light, camera)
        factor = math.pi / normal_irradiance()

        def render(seed):
            image = np.array(self.mi.render(scene, spp=spp, seed=seed))
            return factor * image.mean(axis=(0, 1), dtype=float)

        render(1_000_000 + self.a.seed)  # compiles the kernel
        rows, start = [], cpu_seconds()
        while len(rows) < 16 or cpu_seconds() - start < seconds:
            rows.append(render(10_000 * self.a.seed + len(rows)))
        cpu = cpu_seconds() - start
        rows = np.array(rows)
        if not np.isfinite(rows).all():
            sys.exit(f"mitsuba: a mean is not finite: {rows}")
        error = rows.std(axis=0, ddof=1) / math.sqrt(len(rows))
        return rows.mean(axis=0), error, cpu, len(rows) * 64 * 64 * spp


# ---- goniofit -------------------------------------------------------------------------------------------------------


def one_pose(c):
    fields = "\n".join(f"{k} = {v}" for k, v in c.items())
    return f'name = "one"\ndescription = ""\n\n[[configurations]]\n{fields}\n'


def goniofit_means(a, plan, effort):
    command = [a.goniofit, "render", "means", "--model", "chiang", "--fabric", a.fabric, "--params", a.params]
    command += ["--plan", plan, "--json", "--seed", str(a.seed)] + effort
    environment = dict(os.environ, RAYON_NUM_THREADS="1")
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode != 0:
        sys.exit(done.stderr)
    return json.loads(done.stdout)


def goniofit_seconds(a, plan, seconds):
    """About this many CPU seconds: a short run says how many paths that is."""
    first = goniofit_means(a, plan, ["--paths", "20000"])
    paths = max(20_000, int(20_000 * seconds / first["cpu_s"]))
    return goniofit_means(a, plan, ["--paths", str(paths)])


# ---- the comparison -------------------------------------------------------------------------------------------------


def relative(mean, se):
    """Relative rms error of the three channels, weighted as goniofit does (Khungurn 2015 eq. 20)."""
    return math.sqrt(np.mean(np.square(se))) / max(np.mean(mean), 0.02)


def record(renderer, config, mean, se, cpu, paths):
    error = relative(mean, se)
    return {
        "renderer": renderer, "config": config, "mean": list(map(float, mean)), "se": list(map(float, se)),
        "cpu_s": cpu, "paths": paths, "cpu_s_for_1pct": cpu * (error / 0.01) ** 2,
    }


def compare(a, mitsuba, folder):
    rows = []
    for c, light, camera in poses(a.plan, a.configs):
        plan = folder / "one.toml"
        plan.write_text(one_pose(c))
        ours = goniofit_seconds(a, plan, a.seconds)
        e = ours["configs"][0]
        pair = [record("goniofit", c["config"], e["mean"], e["se"], ours["cpu_s"], e["paths"])]
        pair.append(record("mitsuba", c["config"], *mitsuba.means(light, camera, a.seconds)))
        rows.append(pair)
        report(a, pair)
    return rows


def z_scores(pair):
    ours, theirs = pair
    difference = np.subtract(ours["mean"], theirs["mean"])
    return difference / np.hypot(ours["se"], theirs["se"])


def report(a, pair):
    if a.json:
        for row in pair:
            print(json.dumps(row), flush=True)
        return
    for row in pair:
        mean = " ".join(f"{m:.5f}+-{s:.5f}" for m, s in zip(row["mean"], row["se"]))
        print(f"{row['config']:4} {row['renderer']:9} {mean} {row['cpu_s']:8.1f} {row['cpu_s_for_1pct']:9.2f}")
    z = " ".join(f"{z:+.2f}" for z in z_scores(pair))
    apart = 100 * (np.mean(pair[0]["mean"]) / np.mean(pair[1]["mean"]) - 1)
    ratio = pair[1]["cpu_s_for_1pct"] / pair[0]["cpu_s_for_1pct"]
    print(f"     z {z}   means apart {apart:+.2f} %   CPU ratio to equal error {ratio:.1f}", flush=True)


def totals(a, rows):
    """All configurations to a weighted rms error of 1 %, each configuration with its best share of the time; and what goniofit
    really needs when it renders them together."""
    for k, renderer in enumerate(["goniofit", "mitsuba"]):
        needed = [pair[k]["cpu_s_for_1pct"] for pair in rows]
        best = sum(map(math.sqrt, needed)) ** 2 / len(needed)
        yield {"renderer": renderer, "config": "total", "cpu_s": sum(p[k]["cpu_s"] for p in rows), "cpu_s_for_1pct": best}
    if a.configs:
        return
    together = goniofit_means(a, a.plan, ["--accuracy", "0.02"])
    spent = together["cpu_s"] * (together["weighted_rms_se"] / 0.01) ** 2
    yield {"renderer": "goniofit together", "config": "total", "cpu_s": together["cpu_s"], "cpu_s_for_1pct": spent}


# ---- rays -----------------------------------------------------------------------------------------------------------


def ray_throughput(a, mitsuba):
    """Closest and any hits along random bounce rays: from hits of rays from above, into random directions, as one wavefront."""
    mi = mitsuba.mi
    scene = mitsuba.scene((30.0, 180.0), direction(30.0, 0.0))
    n, random = 1 << 21, np.random.default_rng(a.seed)
    sphere = lambda: (lambda v: v / np.linalg.norm(v, axis=1)[:, None])(random.normal(size=(n, 3)))
    size = UNIT * mitsuba.size
    origin = (random.random((n, 3)) - 0.5) * np.append(size, 0.0) + [0, 0, 0.5 * UNIT]
    d = sphere()
    d[:, 2] = -np.abs(d[:, 2]) - 0.5
    d /= np.linalg.norm(d, axis=1)[:, None]
    make = lambda o, d: mi.Ray3f(mi.Point3f(o.T.astype(np.float32)), mi.Vector3f(d.T.astype(np.float32)))
    hit = scene.ray_intersect_preliminary(make(origin, d), coherent=False)
    t = np.array(hit.t)
    start = origin + d * t[:, None]
    keep = np.isfinite(t) & (np.abs(start[:, :2]) < size / 2).all(axis=1)
    start, out = start[keep], sphere()[keep]
    rays = make(start, out)
    import drjit as dr

    dr.eval(rays)
    count = len(start)
    for name, test in [
        ("closest", lambda: scene.ray_intersect_preliminary(rays, coherent=False).t),
        ("any", lambda: scene.ray_test(rays)),
    ]:
        best = math.inf
        for _ in range(6):
            before = cpu_seconds()
            found = np.array(test())
            best = min(best, cpu_seconds() - before)
        hits = np.isfinite(found).mean() if name == "closest" else found.mean()
        print(json.dumps({"rays": name, "count": count, "hit_fraction": float(hits), "mrays_per_cpu_s": count / best / 1e6}))


def main():
    a = arguments()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        size, curves = load_curves(a.goniofit, a.fabric, folder)
        path = folder / "curves.txt"
        copies = math.ceil(MARGIN / min(size)) if a.copies is None else a.copies
        curves = replicate(size, curves, copies)
        write_curves(curves, path)
        params = json.loads(a.params.read_text())
        mitsuba = Mitsuba(a, size, path, params, curves)
        if a.rays:
            return ray_throughput(a, mitsuba)
        if not a.json:
            print("config          mean and standard error (r, g, b), normalized radiance        CPU s   to 1 %")
        rows = compare(a, mitsuba, folder)
        for row in totals(a, rows):
            if a.json:
                print(json.dumps(row))
            else:
                print(f"{row['renderer']}: all configurations to 1 % in {row['cpu_s_for_1pct']:.1f} CPU s")


if __name__ == "__main__":
    main()
