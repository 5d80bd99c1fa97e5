"""The problems of the `exact` planners in CasADi's symbols, for IPOPT."""
