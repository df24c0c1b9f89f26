"""The Ouster as a ray caster: beams, footprints, photons, returns."""
