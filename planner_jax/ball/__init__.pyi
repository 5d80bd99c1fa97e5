from .recording import BALLS as BALLS
from .recording import Ball as Ball
from .recording import FlightFit as FlightFit
from .recording import Prediction as Prediction
from .recording import fit as fit
