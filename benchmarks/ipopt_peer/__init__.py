"""The problems of the `exact` planners once more in CasADi's symbols, for IPOPT."""
