"""The least-squares problem of an interception: cost, stages of its solution, and derivatives.

The n unknowns are speed and curvature at K equally spaced times (knots) after the start, and the
time of the meeting if it is free. The cost is a sum of squares (`terms`): the discomfort, which
is an integral of squared accelerations, lateral jerk and steering rate; the distance from the
target at the end; and one-sided penalties (hinges) on limits and on distances from obstacles.

The search for a path round the obstacles cannot be differentiated. Its path only determines where
least squares start and which local minimum of the cost they reach. This minimum moves smoothly with
the numbers of the case, and the implicit function theorem gives its derivatives. Hinges that are
zero at the minimum contribute nothing to the derivatives.
"""
