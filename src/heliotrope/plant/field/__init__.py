"""What the plant knows of its field: reports, orders in force, locks, beliefs, and what it doubts.

`FieldState` holds the reports of all heliostats as arrays, `Ledger` what each was sent last,
`Assigned` the aims and standby points that people and automatic control gave, and `Witnesses`
whether the sun is where the plant computes it.
"""
