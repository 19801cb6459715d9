"""The dashboard (`app.py`, a Streamlit script) and its SQL."""
