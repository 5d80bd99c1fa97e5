from .case import GroupPlan as GroupPlan
from .case import InterceptGroup as InterceptGroup
from .case import group as group
from .decide import Best as Best
from .decide import Given as Given
from .decide import Greedy as Greedy
