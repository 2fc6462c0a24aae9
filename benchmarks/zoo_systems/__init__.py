"""Parts of `benchmarks/zoo.py`: mechanisms drawn at random, their exact motions, peers and the judgement."""
