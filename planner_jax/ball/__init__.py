"""Models of the ball: flight with drag, impact on a racket, prediction and state estimation."""
