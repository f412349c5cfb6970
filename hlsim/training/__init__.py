"""Lightning recipes that train simulators and compensators (extra ``train``)."""
