"""The catch sweep: suites, columns, table and figures of catches with a net."""
