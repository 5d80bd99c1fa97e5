"""Malformed options and files, which every command must reject with one line.

A row has a command line, and parts of the expected error message. The names `pipe`, `folder`,
`empty`, `junk` and `gone` are paths: a named pipe, a folder, an empty, a damaged, a missing file.
"""

TASKS = ("hit", "catch", "intercept", "block")
HIT = "plan hit --vel -3 0.2 4 --target 4 0 0"
CATCH = "plan catch --pos 3 0 1 --vel -3 0.2 4"

# One row a line: the words of a command, the wrong word last; and parts of the expected error
# message, separated by "..".
_ROWS = """
sweep hit --num 0                            | --num must be >= 1, got 0
sweep catch --num 1000000000000000           | --num must be at most
sweep block --num 99999999999999999999       | --num must be < 2**63
sweep intercept --num 1000000 --batch 1000000000 | memory
sweep hit --seed -1                          | --seed must be >= 0, got -1
sweep catch --planner nobody                 | --planner must be one of exact .. got 'nobody'
sweep hit --planner exact:file               | --planner must be exact without a file
sweep block --planner library                | --planner must name its file
sweep intercept --suite nowhere              | --suite must be one of
sweep group --suite forty --decide best      | --decide must be search or greedy for suite forty
sweep rally --decide best                    | --decide best; `planner-jax sweep rally --help`
bench throughput --task rally --effort good  | --effort must be left out for the task rally
sweep hit --num 1 --out pipe                 | --out must be
sweep catch --num 1 --out s3://bucket/x      | --out must be a folder of this machine
sweep hit --num 1 --workers Ray              | --workers must be ray
sweep hit --resume --out gone                | --out must be
sweep hit stray                              | unrecognized .. stray
sweep hit --speed 3                          | unrecognized arguments .. --speed
sweep hit --batch 0                          | --batch must be >= 1, got 0
sweep hit --resume                           | --out must name the folder to resume
sweep hit --suite throws                     | --suite must be one of court, S.1 .. got 'throws'
sweep hit --delay 3            | --delay must be shorter than each serve's flight .. got 3
sweep hit --limit-scale 1e-300               | --limit-scale must be from 0.001 to 1000
sweep catch --limit-scale nan                | --limit-scale must be from 0.001 to 1000
sweep hit --effort more                      | --effort must be one of feasible
sweep block --effort more                    | --effort must be one of feasible
sweep catch --recovery land                    | --recovery must be one of none
sweep hit --delay inf                        | --delay must be finite and >= 0
sweep hit --start nan 0 1                    | --start must be
sweep hit --start 1 2                        | --start must be
sweep catch --planner bat      | --planner must be one of exact, catch, mpp .. got 'bat'
sweep catch --decide later     | --decide must be one of best, greedy, random .. got 'later'
sweep catch --decide best:x                  | --decide must be best without a file
sweep catch --tolerance -1                   | --tolerance must be finite and >= 0
sweep catch --net-test box                   | --net-test must be one of plane
fly block --frame-rate 1e300                 | --frame-rate must
sweep block --regime R9                      | --regime must be one of R1
fly hit --num 0                              | --num must be >= 1
fly catch --balls 13                         | --balls must be <=
fly catch --redecide 7                       | --redecide must be
fly intercept --latency nan                  | --latency must
fly block --torque 0                         | --torque must
fly hit --seen 0                             | --seen must be > 0 and <= 1, got 0
fly hit --replan 1e300                       | --replan must be <=
fly hit --video a/b.gif                      | --video must be a file name
fly catch --noise x                          | --noise must
fly hit --observer x                         | --observer must be one of default, published
plan hit --vel -3 0.2 4 --target 4 0 0       | --pos
plan hit --vel -3 0.2 4 --target 4 0 0 --pos 1 nan 2 | --pos must be finite, got nan
plan hit --vel -3 0.2 4 --target 4 0 0 --pos 4 0 1 --speed inf | --speed must be finite
plan hit --vel -3 0.2 4 --target 4 0 0 --pos 4 0 1 --out junk/below | --out must be in a folder
plan catch --horizon 1 --ball 1 2 3          | --ball
plan block                                   | --pos
plan block --pos 9 0 0 --vel -8 0 5 --tip x  | --tip must be left out
plan intercept                               | --map
plan intercept --map gone                    | --map must be a file that can be read .. got 'gone'
plan intercept --map folder                  | --map must be a file that can be read
plan intercept --map pipe                    | --map must be a file that can be read
plan intercept --map empty                   | empty: must be fields with values, got None
plan intercept --map junk                    | junk: must be YAML
plan intercept --map junk --planner nobody   | --planner must be one of spacetime .. got 'nobody'
plan intercept --map junk --rate 5           | --rate must be left out without --out
export junk --row 0 --to csv --recovery land   | --recovery must be one of none
serve hit --port 65536                       | --port must
serve catch --deadline 0                     | --deadline must
serve hit --robot nobody                     | --robot must be
library build new --home 1                   | --home must be six angles
library build new --home nan nan nan nan nan nan | --home must be finite
library build new --layout x                 | --layout must be one of
library build new --planner rrt              | --planner must be one of
library repair junk --pole 1 --out new       | --pole
library check junk --num 0                   | --num must be >= 1
bench throughput --planner mpp               | --planner must be one of exact, bat .. got 'mpp'
bench throughput --task catch --suite court  | --suite must be one of throws .. got 'court'
bench throughput --seed -1                   | --seed must be >= 0, got -1
bench throughput --repeat 0                  | --repeat must be >= 1, got 0
bench throughput --task x                    | --task must
bench throughput --devices 1000              | --devices must
bench throughput --batch 16 0                | --batch must be >= 1
robots nobody                                | robot must be one of
train --suite x                              | --suite must be one or more of
train --starts moving                        | --starts must be one of hover, random
train --policy x                             | --policy must be one of extended, published
train --policy published                     | --suite must be one suite in which every target
train --policy published --suite swarm8      | --suite must be one suite in which every target
train --policy published --suite hexagon6 --network mlp | --network must be left out
view folder --port x                         | --port must be a whole number, got 'x'
report gone                                  | RUN must be
nobody                                       | nobody
doctor x                                     | unrecognized
report pipe                                  | RUN must be
view folder                                  | RUN must be
compare empty empty                          | RUN must be
export junk --row 0 --to csv                 | RUN must be
library show gone                            | library must be
sweep hit --serves /dev/zero                 | --serves must
sweep catch --num 1 --decide policy:pipe     | checkpoint must be
sweep block --num 1 --planner library:folder | library must be
"""
ROWS = [
    (tuple(words.split()), says.strip().split(" .. "))
    for words, says in (line.split("|") for line in _ROWS.strip().splitlines())
]
# Commands, each with an option that accepts a whole number; Hypothesis draws malformed values.
WHOLE = (
    *((f"sweep {task}", option) for task in TASKS for option in ("--num", "--batch", "--seed")),
    *((f"fly {task}", option) for task in TASKS for option in ("--num", "--batch", "--record")),
    *(("fly catch", "--balls"), ("export junk --to csv", "--row")),
    *(("export junk --to px4", "--udp"), ("view folder", "--port")),
    *(("serve hit", "--port"), ("serve catch", "--horizon")),
    *(("library check junk", "--num"), ("library check junk", "--seed")),
    *(("bench throughput", "--devices"), ("bench throughput", "--repeat"), ("train", "--num-envs")),
)
NUMBERS = (
    *(("sweep hit", "--delay"), ("sweep hit", "--limit-scale"), ("sweep catch", "--tolerance")),
    *(("fly block", "--noise"), ("fly hit", "--drag-error"), ("fly block", "--torque")),
    *((f"{HIT} --pos 4 0 1", option) for option in ("--speed", "--gravity", "--min-height")),
    *((CATCH, "--horizon"), ("export junk --to csv", "--rate"), ("serve hit", "--rate")),
    *(("fly intercept", "--latency"), ("library build new", "--home"), ("train", "--decisions")),
)
WORDS = (
    *((f"sweep {task}", option) for task in TASKS for option in ("--planner", "--suite")),
    *(("sweep hit", "--effort"), ("sweep hit", "--recovery"), ("sweep catch", "--decide")),
    *(("sweep catch", "--net-test"), ("sweep block", "--regime"), ("fly hit", "--noise")),
    *((f"fly {task}", "--planner") for task in TASKS),
    *((f"{HIT} --pos 4 0 1", option) for option in ("--planner", "--recovery")),
    ("plan intercept --map junk", "--planner"),
    *(("export junk --row 0", "--to"), ("bench throughput", "--task"), ("serve hit", "--robot")),
    *(("library build new", "--layout"), ("train", "--suite"), ("bench throughput", "--planner")),
)
