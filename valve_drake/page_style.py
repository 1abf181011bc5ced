"""The style sheet that the self-contained pages of one report share; each page adds its own rules."""

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #1c2430; max-width: 1080px; margin: 2em auto; padding: 0 1em }
h1 { font-size: 1.5em; margin-bottom: .2em }
h2 { font-size: 1.1em; margin-top: 1.8em; border-bottom: 1px solid #d8dde4 }
table { border-collapse: collapse }
td, th { padding: .15em .9em .15em 0; text-align: right; font-variant-numeric: tabular-nums }
td:first-child, th:first-child { text-align: left }
th { color: #667; font-weight: 500 }
.note { color: #667 }
"""
