"""Kernels of package `warp-lang`: rays of a revolution at one triangle mesh, the same on a GPU and on a CPU.

No product is fused with a sum (`fuse_fp`), so both devices round alike. The mesh query finds the face in float32;
distance and cosine follow in float64 from the plane of that face.
"""

# Warp reads the annotations of a kernel when it is decorated: they must be objects, not strings, and are no types.
# mypy: ignore-errors
import warp as wp

wp.set_module_options({"fuse_fp": False, "enable_backward": False})


@wp.struct
class Target:
    """A mesh, and the number of the geom that each of its faces belongs to."""

    mesh: wp.uint64
    geoms: wp.array(dtype=wp.int32)


@wp.struct
class BeamShape:
    """A bundle of rays as in `sim.geometry.bundles`: x, y and length of each; radius and slope of the beam."""

    places: wp.array(dtype=wp.vec3)
    radius_m: wp.float32
    slope: wp.float32
    centre_m: wp.vec3d


@wp.struct
class Hit:
    """The first hit of a ray: distance, geom, absolute cosine of the incidence; infinity, -1 and 0 for a miss."""

    range_m: wp.float32
    geom: wp.int32
    cosine: wp.float32


@wp.func
def meet(target: Target, origin: wp.vec3, way: wp.vec3) -> Hit:
    """Return the first hit of a ray."""
    hit = Hit()
    hit.range_m = wp.float32(wp.inf)
    hit.geom = -1
    query = wp.mesh_query_ray(target.mesh, origin, way, wp.inf)
    if query.result:
        hit.range_m = query.t
        hit.geom = target.geoms[query.face]
        a = wp.vec3d(wp.mesh_get_point(target.mesh, 3 * query.face))
        b = wp.vec3d(wp.mesh_get_point(target.mesh, 3 * query.face + 1))
        c = wp.vec3d(wp.mesh_get_point(target.mesh, 3 * query.face + 2))
        normal = wp.cross(b - a, c - a)
        along = wp.dot(normal, wp.vec3d(way))
        if along != wp.float64(0.0):
            hit.range_m = wp.float32(wp.dot(normal, a - wp.vec3d(origin)) / along)
            hit.cosine = wp.float32(wp.abs(along) / wp.length(normal))
    return hit


@wp.kernel
def cast_rays(
    target: Target,
    origins: wp.array(dtype=wp.vec3),
    ways: wp.array(dtype=wp.vec3),
    ranges_m: wp.array(dtype=wp.float32),
    geoms: wp.array(dtype=wp.int32),
    cosines: wp.array(dtype=wp.float32),
) -> None:
    """Cast rays (N,) from the centre of the scene."""
    ray = wp.tid()
    hit = meet(target, origins[ray], ways[ray])
    ranges_m[ray] = hit.range_m
    geoms[ray] = hit.geom
    cosines[ray] = hit.cosine


@wp.kernel
def cast_bundles(
    target: Target,
    shape: BeamShape,
    starts: wp.array(dtype=wp.vec3d),
    directions: wp.array2d(dtype=wp.vec3),
    ranges_m: wp.array2d(dtype=wp.float32),
    geoms: wp.array2d(dtype=wp.int32),
    cosines: wp.array2d(dtype=wp.float32),
) -> None:
    """Make the rays of every beam (W, H) as `sim.geometry.bundles.make_bundle_rays` does, and cast them: (n, W * H)."""
    column, row, ray = wp.tid()
    way = directions[column, row]
    place = shape.places[ray]
    x, y = wp.float64(way[0]), wp.float64(way[1])
    level = wp.max(wp.float32(wp.sqrt(x * x + y * y)), 1e-6)  # as `hypotf` rounds
    right = wp.vec3(way[1] / level, -way[0] / level, 0.0)
    up = wp.vec3(right[1] * way[2], right[0] * -way[2], level)
    aside = right * place[0] + up * place[1]
    origin = wp.vec3(starts[column] + wp.vec3d(aside * shape.radius_m) - shape.centre_m)
    turned = aside * shape.slope + way
    # Vector by scalar would multiply with the reciprocal.
    turned = wp.vec3(turned[0] / place[2], turned[1] / place[2], turned[2] / place[2])
    beam = column * directions.shape[1] + row
    hit = meet(target, origin, turned)
    ranges_m[ray, beam] = hit.range_m
    geoms[ray, beam] = hit.geom
    cosines[ray, beam] = hit.cosine
