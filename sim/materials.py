"""What things are made of, and how much light of the LiDAR's 865 nm they send back.

Shares of a perfect diffuse reflector. Typical figures for these materials in the near infrared; none is measured for
the sensor modelled here, so all of them are unverified. Retroreflectors are cut off at 1.
"""

from __future__ import annotations

REFLECTIVITY: dict[str, float] = {
    "rock": 0.25,
    "wood": 0.5,
    "paper": 0.6,  # cardboard
    "plastic": 0.45,
    "rubber": 0.06,
    "steel": 0.35,  # galvanised
    "paint": 0.4,  # painted steel
    "fabric": 0.3,
    "glass": 0.05,  # most of the light goes through or is mirrored away
    "reflector": 1.0,
}
