# The rig as a server. Without certificates it accepts only connections of the same machine, so that a container needs
# the network of the machine:
#   docker build -t shotrig .
#   docker run --rm --network host shotrig                                         # NI clients: 127.0.0.1:31763
#   docker run --rm --network host shotrig daq bench fig9 --no-browser             # prints the address of the page
# To serve other machines, mount certificates and give --address, --certificate and --key (see daq serve --help).
FROM python:3.13-slim
WORKDIR /shotrig
COPY . .
RUN pip install --no-cache-dir ".[bench]" && useradd --create-home user
USER user
WORKDIR /home/user
# Kernels that are compiled during the build are used on processors of the same kind.
RUN python -c "import daq; daq.warm_up()"
CMD ["daq", "serve", "fig8-three-dampers"]
