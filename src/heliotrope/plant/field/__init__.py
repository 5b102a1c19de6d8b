"""The plant's knowledge of its field: reports, current orders, locks, beliefs, and doubts.

`FieldState` holds the reports of all heliostats as arrays, `Ledger` the last orders sent to each
heliostat, `Assigned` the aims and standby points assigned by operators and automatic control, and
`Witnesses` whether the sun is where the plant computes it.
"""
