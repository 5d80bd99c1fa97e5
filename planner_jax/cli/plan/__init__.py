"""The command `plan`: one case in a few numbers, planned and refereed."""
