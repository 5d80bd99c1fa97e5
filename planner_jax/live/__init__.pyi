from .client import Client as Client
from .packets import Answer as Answer
from .packets import Fault as Fault
from .packets import Motion as Motion
from .planner import LivePlanner as LivePlanner
from .server import Server as Server
from .strokes import CatchStroke as CatchStroke
from .strokes import HitStroke as HitStroke
