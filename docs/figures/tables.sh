#!/usr/bin/env bash
# The paper's Tables I, III and IV, and a comparison of normalisations.
#
#   [STEPS=10000] [JOBS=2] [ROWS="paper/cnn neuro-msbg-lstm:model.phase=input:seed=1"] \
#       docs/figures/tables.sh CORPORA OUT [ITEMS]
#
# Trains each row on one thread, and compares the rows. If it is stopped, the same command continues. Results are in
# docs/paper-tables.md, except for the paper's rows at full width, which require a GPU.
#
# CORPORA contains speech/{train,valid}, noise/{train,valid} and audiograms/{train,valid}.csv.
# STEPS: number of steps per row, instead of that of its recipe
# JOBS: number of rows that are trained at the same time
# ROWS: rows to train instead of all, which are compared as in Table I; each is a recipe, with changed settings after
#     colons
set -euo pipefail
corpora=$1 out=$2 items=${3:-80}
here=$(dirname "${BASH_SOURCE[0]}")
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

folder() { # row
    basename "${1//[:=]/-}"
}

train() { # row: recipe[:setting=value[...]]
    local parts settings
    IFS=: read -ra parts <<<"$1${STEPS:+:steps=$STEPS}"
    settings=("${parts[@]:1}")
    hlsim train-simulator --recipe "$here/${parts[0]}.yaml" "${settings[@]/#/--recipe.}" \
        --out "$out/$(folder "$1")" \
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
    read -rd "" -a rows <<<"$ROWS" || true
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
