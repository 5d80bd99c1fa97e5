"""The intercept sweep: suites, columns, table and figures of a car that meets a moving target."""
