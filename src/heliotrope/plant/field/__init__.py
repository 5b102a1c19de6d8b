"""The plant's knowledge of its field: reports, orders in force, locks, beliefs, and doubts.

`FieldState` holds the reports of all heliostats as arrays, `Ledger` what each was sent last,
`Assigned` the aims and standby points that people and automatic control gave, and `Witnesses`
whether the sun is where the plant computes it.
"""
