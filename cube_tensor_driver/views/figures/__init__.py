"""Pictures that commands write to files: functions that draw results as matplotlib figures."""
