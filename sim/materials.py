"""What things are made of, and how much light of the LiDAR's 865 nm they send back.

Shares of a perfect diffuse reflector. Typical figures for these materials in the near infrared; none is measured for
the sensor modelled here, so all of them are unverified. The one far above 1 is a
retroreflector (`sim.sensor.optics.reflected_share`).
"""

from __future__ import annotations

import math

# Coefficient of retroreflection of the bands of warning clothes, cd/(lx m2), at 0.2 deg of observation and 5 deg of
# entrance: the least that EN ISO 20471 asks of new ones, in visible light. A white diffuse surface has 1 / pi.
RETRO_CD_PER_LX_M2 = 330.0
REFLECTIVITY: dict[str, float] = {
    "rock": 0.25,
    "wood": 0.5,
    "paper": 0.6,  # cardboard
    "plastic": 0.45,
    "rubber": 0.06,
    "steel": 0.35,  # galvanised
    "paint": 0.4,  # painted steel
    "fabric": 0.3,
    "glass": 0.05,  # dust on it; most of the light goes through or is mirrored away
    "reflector": math.pi * RETRO_CD_PER_LX_M2,
}
