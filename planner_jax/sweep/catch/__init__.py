"""The catch sweep: settings, columns, table and figures of catches with a net."""
