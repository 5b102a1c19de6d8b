"""Orders: who may issue them, what blocks them, their tickets, and their records.

`Authority` determines who commands, `guards` is the table of what blocks a command, `PlantOrders`
writes the record and sends the command, `JoinQueue` spreads heliostats that join a receiver over
time, and `ParameterSync` keeps the parameters in local controllers equal to the plant's.
"""
