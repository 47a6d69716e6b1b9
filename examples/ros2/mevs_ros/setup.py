from setuptools import setup

setup(
    name="mevs_ros",
    version="0.3.0",
    packages=["mevs_ros"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/mevs_ros"]),
        ("share/mevs_ros", ["package.xml"]),
        ("share/mevs_ros/launch", ["launch/recognise.launch.py"]),
    ],
    install_requires=["mevs-jax"],
    entry_points={"console_scripts": ["recognise = mevs_ros.node:main"]},
)
