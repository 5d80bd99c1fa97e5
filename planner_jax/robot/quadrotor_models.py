"""Quadrotors by name: those of the papers.

The papers give neither mass, inertia nor rotors. Those of their quadrotors here are assumptions:
0.9 kg of computer, battery and frame within 5 cm of the centre and 75 g of motor and propeller at
the end of each arm, whose diagonal is the papers'. The greatest thrust is 4 g, so that a plan of
2.5 g leaves room for control. As in the papers, plans are not asked what the rotors do.
"""

import dataclasses

from planner_jax.robot.quadrotor_model import (
    GRAVITY,
    NET,
    RACKET,
    FlightLimits,
    QuadrotorModel,
    Rotors,
    Tool,
    cross,
)

# Paper 000: l and radius of the net (Fig. 6). It gives no limits; these are the shared protocol's.
PAPER_CATCHER = QuadrotorModel(
    name="paper-catcher",
    mass=1.2,
    inertia=(0.005, 0.005, 0.009),
    rotors=Rotors(cross(0.33), max_thrust=11.8),
    tool=Tool(NET, height=0.2, radius=0.125),
    limits=FlightLimits(
        speed=5.0, body_rate=5.0, thrust=(0.3 * GRAVITY, 2.5 * GRAVITY), rotor_share=None
    ),
    source="paper 000 (Catch Planner); body and rotors assumed",
)
# Paper 002: Fig. 2 and Section VI-A.
PAPER_HITTER = dataclasses.replace(
    PAPER_CATCHER,
    name="paper-hitter",
    tool=Tool(RACKET, height=0.06, radius=0.11),
    limits=FlightLimits(speed=5.0, body_rate=5.0, acceleration=15.0, rotor_share=None),
    source="paper 002 (Bat Planner); body and rotors assumed",
)

MODELS = {model.name: model for model in (PAPER_CATCHER, PAPER_HITTER)}
