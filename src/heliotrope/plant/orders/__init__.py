"""Orders: who may give them, what blocks them, their tickets, and their records.

`Authority` says who commands, `guards` is the table of what blocks a command, `PlantOrders` writes
the record and sends, `JoinQueue` spreads heliostats that join a receiver over time, and
`ParameterSync` keeps what local controllers store equal to the plant's.
"""
