#!/usr/bin/env bash
# The paper's Tables I, III and IV, and the comparison of normalisations: trains every row for the same time on one
# thread, and compares them. Killed, it goes on with the same command. The results of one such run are in docs/paper-tables.md.
#
#   examples/tables.sh CORPORA OUT [MINUTES A ROW] [ITEMS]
#
# CORPORA holds speech/{train,valid}, noise/{train,valid} and audiograms/{train,valid}.csv.
set -euo pipefail
corpora=$1 out=$2 minutes=${3:-5} items=${4:-80}
here=$(dirname "${BASH_SOURCE[0]}")
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}

train() { # recipe
    hlsim train-simulator --config "$here/$1.yaml" --max-minutes "$minutes" --quiet --out "$out/$(basename "$1")" \
        --speech "$corpora/speech/train" --valid-speech "$corpora/speech/valid" \
        --noise "$corpora/noise/train" --valid-noise "$corpora/noise/valid" \
        --audiograms "$corpora/audiograms/train.csv" --valid-audiograms "$corpora/audiograms/valid.csv"
}

compare() { # name of the table, options of evaluate-simulator, --, rows
    local table=$1 options=() checkpoints=()
    shift
    while [[ $1 != -- ]]; do options+=("$1") && shift; done
    shift
    for row; do checkpoints+=("$out/$row/checkpoint"); done
    hlsim evaluate-simulator "${checkpoints[@]}" --speech "$corpora/speech/valid" --noise "$corpora/noise/valid" \
        --audiograms "$corpora/audiograms/valid.csv" --items "$items" --out "$out/$table" "${options[@]}"
}

table1=(monolithic-transformer monolithic-cnn monolithic-lstm transformer cnn lstm mamba)
for row in "${table1[@]}" mamba-magnitude-only mamba-concatenated; do train "paper/$row"; done
for row in mamba lstm transformer cnn cnn-normalised; do train "neuro-msbg-$row"; done

compare table-1 --levels 65 --seconds 2 -- "${table1[@]}"
compare table-3 --levels 65 --seconds 2 -- mamba-magnitude-only mamba
compare table-4 --levels 65 --seconds 2 -- mamba-concatenated mamba
compare levels --levels 40 50 60 70 80 90 100 -- neuro-msbg-cnn-normalised neuro-msbg-cnn
compare family -- neuro-msbg-mamba neuro-msbg-lstm neuro-msbg-transformer neuro-msbg-cnn
