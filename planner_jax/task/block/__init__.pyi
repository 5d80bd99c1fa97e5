from .case import BlockCase as BlockCase
from .case import case as case
from .plan import BlockPlan as BlockPlan
from .scene import Scene as Scene
from .scene import paper_scene as paper_scene
