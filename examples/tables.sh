#!/usr/bin/env bash
# The paper's Tables I, III and IV, and the comparison of normalisations: trains every row on one thread, and compares
# them. Killed, it goes on with the same command. Results are in docs/paper-tables.md, but for the paper's rows at full
# width, which want a GPU.
#
#   [STEPS=10000] [NARROW=4] [JOBS=2] [ROWS="paper/cnn neuro-msbg-lstm:phase=input:seed=1"] \
#       examples/tables.sh CORPORA OUT [ITEMS]
#
# CORPORA holds speech/{train,valid}, noise/{train,valid} and audiograms/{train,valid}.csv.
# STEPS: of each row, instead of those of its recipe. NARROW: the paper's rows with as
# many times fewer channels and heads. JOBS: rows trained at a time. ROWS: these alone, compared as Table I; what follows a
# colon changes the recipe's network, seed or precision.
set -euo pipefail
corpora=$1 out=$2 items=${3:-80}
here=$(dirname "${BASH_SOURCE[0]}")
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
mkdir -p "$out/recipes"

folder() { # row
    basename "${1//[:=]/-}"
}

train() { # row: recipe[:setting=value[...]]
    local name=$(folder "$1") given=${1#"${1%%:*}"}${STEPS:+:steps=$STEPS}
    local recipe="$out/recipes/$name.yaml"
    awk -v by="$([[ $1 == paper/* ]] && echo "${NARROW:-1}" || echo 1)" -v given="${given#:}" '
        function of_recipe(name) { return name ~ /^(seed|precision|steps):$/ }  # others are of the network
        BEGIN { for (n = split(given, pairs, ":"); n; n--) { split(pairs[n], pair, "="); value[pair[1] ":"] = pair[2] } }
        $1 == "channels:" && by > 1 { $0 = "  channels: " 4 * int($2 / by / 4 + 0.5) }
        $1 == "heads:" && by > 1 { $0 = "  heads: " int(($2 + by - 1) / by) }  # heads stay as wide
        /^[a-z]/ { part = $1 }
        !($1 in value) || part == "weights:"
        $1 == "model:" { for (name in value) if (!of_recipe(name)) print "  " name, value[name] }
        END { for (name in value) if (of_recipe(name)) print name, value[name] }
    ' "$here/${1%%:*}.yaml" >"$recipe"
    hlsim train-simulator --config "$recipe" --quiet --out "$out/$name" \
        --speech "$corpora/speech/train" --valid-speech "$corpora/speech/valid" \
        --noise "$corpora/noise/train" --valid-noise "$corpora/noise/valid" \
        --audiograms "$corpora/audiograms/train.csv" --valid-audiograms "$corpora/audiograms/valid.csv"
}

compare() { # name of the table, options of evaluate-simulator, --, rows
    local table=$1 options=() checkpoints=()
    shift
    while [[ $1 != -- ]]; do options+=("$1") && shift; done
    shift
    for row; do checkpoints+=("$(folder "$row")=$out/$(folder "$row")/checkpoint"); done
    hlsim evaluate-simulator "${checkpoints[@]}" --speech "$corpora/speech/valid" --noise "$corpora/noise/valid" \
        --audiograms "$corpora/audiograms/valid.csv" --items "$items" --out "$out/$table" \
        --teacher examples/pyclarity_teacher.py:PyclarityMSBG "${options[@]}"
}

train_all() { # recipes, JOBS at a time
    local row pid pids=() failed=0
    for row; do
        while (($(jobs -rp | wc -l) >= ${JOBS:-1})); do wait -n || failed=1; done
        train "$row" &
        pids+=("$!")
    done
    for pid in "${pids[@]}"; do wait "$pid" || failed=1; done
    return "$failed"
}

if [[ -n ${ROWS:-} ]]; then
    read -ra rows <<<"$ROWS"
    train_all "${rows[@]}"
    compare table-1 --levels 65 --seconds 2 -- "${rows[@]}"
    exit
fi

table1=(monolithic-transformer monolithic-cnn monolithic-lstm transformer cnn lstm mamba)
family=(neuro-msbg-{mamba,lstm,transformer,cnn,cnn-normalised})
train_all "${table1[@]/#/paper/}" paper/mamba-magnitude-only paper/mamba-concatenated "${family[@]}"

compare table-1 --levels 65 --seconds 2 -- "${table1[@]}"
compare table-3 --levels 65 --seconds 2 -- mamba-magnitude-only mamba
compare table-4 --levels 65 --seconds 2 -- mamba-concatenated mamba
compare levels --levels 40 50 60 70 80 90 100 -- neuro-msbg-cnn-normalised neuro-msbg-cnn
compare family -- neuro-msbg-mamba neuro-msbg-lstm neuro-msbg-transformer neuro-msbg-cnn
