"""Layers of the paper's other networks: Mamba, LSTM, Transformer, and frames without frequency."""
