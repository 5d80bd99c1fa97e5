from .api import judge as judge
from .api import planner as planner
from .case import ReachCase as ReachCase
from .case import Scene as Scene
from .case import case as case
from .case import make_scene as make_scene
from .default_planner import ReachPlan as ReachPlan
from .default_planner import ReachPlanner as ReachPlanner
